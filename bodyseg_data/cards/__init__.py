"""Cards of sets: a Croissant file and a dataset card, written from the manifest."""
