"""Commands that use networks, one module each."""
