"""People among things: surfaces and planes of a frame, and the score that tells a person from a thing."""
