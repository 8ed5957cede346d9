"""Labels for the frames of a real sensor."""
