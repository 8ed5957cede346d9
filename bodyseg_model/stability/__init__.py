"""Robustness of trained networks: to sensor artifacts of rising strength, through motion, to the arithmetic used."""
