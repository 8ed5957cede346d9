"""Copies of sets and networks between folders and addresses: resumed, verified, complete only at their end."""
