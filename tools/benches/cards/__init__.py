"""`tools/card`: a Croissant file and a dataset card of a set, a page of a network, from the manifest or the card."""
