"""Networks side by side; `tools/bench` calls `bench_NAME` of NAME.py and lets NAME_figure.py draw its answer."""
