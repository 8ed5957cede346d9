"""Noise of range: residuals, their variances by range and incidence, and the formula that explains them."""
