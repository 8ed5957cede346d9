"""Damage, hostile input and interruptions at full length."""
