"""Registry of sources of bodies."""
