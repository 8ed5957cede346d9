"""Ranges that are wrong: noise that grows with range and incidence, rounding, pixels between two surfaces."""
