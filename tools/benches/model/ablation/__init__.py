"""Gain and cost of each modelled effect."""
