"""Benches and charts of a checkout: measurements beside baselines, not installed."""
