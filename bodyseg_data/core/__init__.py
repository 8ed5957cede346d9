"""Ideas that every room shares: errors, parts, rig, sample, random numbers, files."""
