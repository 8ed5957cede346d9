"""What a structured-light sensor does to a clean range image: projector shadow, noise, missing data."""
