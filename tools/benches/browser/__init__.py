"""Pages in a headless browser: what they show, and what their controls change."""
