"""People with annotated landmarks: proposals of landmarks and a network's scores, measured on their bodies."""
