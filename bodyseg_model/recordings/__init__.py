"""Recordings of range sensors: frames in files, folders, tars and bags, their cameras and their names in results."""
