"""Triangle meshes of bodies: reading, repair, landmarks, and their partition into 33 parts."""
