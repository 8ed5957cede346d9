"""The command `bodyseg segment` on made rooms: how fast every stage is, and who is found."""
