"""Rooms with people."""
