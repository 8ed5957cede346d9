"""Benches of networks: each `bench_NAME` returns its results as JSON, and a `draw_NAME` draws them."""
