"""Methods on surfaces: partition, borders, reduction, clothes, landmark proposals."""
