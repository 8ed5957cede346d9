"""Commands for sets and networks that others are to use: cards, and copies at addresses."""
