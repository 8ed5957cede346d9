"""Benches of the data path: methods beside their baselines in one run, against an exact reference if there is one."""
