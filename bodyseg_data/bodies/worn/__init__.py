"""Pieces over the body's own surface: skirts, coats, hair, shoes, and things held or worn."""
