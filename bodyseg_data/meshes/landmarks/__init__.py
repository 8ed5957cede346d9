"""The 33 landmarks of a mesh: by vertex, by coordinate, from CAESAR's files."""
