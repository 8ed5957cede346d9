"""Sets and recordings in a browser: what is drawn, and the page that shows it."""
