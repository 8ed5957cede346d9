"""The worth and price of each thing that is modelled."""
