"""Pixels that sensors lose: in patches, in stripes, at grazing incidence, at edges."""
