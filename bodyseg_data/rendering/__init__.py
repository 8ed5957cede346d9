"""Registry of renderers."""
