"""People found in rooms: real frames with masks, and made rooms of things that no network was trained on."""
