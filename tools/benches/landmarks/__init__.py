"""`tools/landmarks`: pictures of the 33 parts of a body, and landmarks proposed by fitting the open body to a mesh."""
