"""The 33 landmarks of a mesh: by vertex, by coordinate, or from files of the CAESAR survey."""
