"""The page in the browser: its server, its controls, and when it is drawn anew."""
