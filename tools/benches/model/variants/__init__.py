"""Networks trained on the five variants."""
