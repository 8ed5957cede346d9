"""Stores: a folder of this machine, or an address."""
