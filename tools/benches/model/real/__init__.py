"""Real frames with cameras: a person fused from them, labelled, and a network's answers compared with the labels."""
