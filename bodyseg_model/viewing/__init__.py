"""Sets and recordings in a browser or in a file for Rerun: what is drawn, and the page that shows it."""
