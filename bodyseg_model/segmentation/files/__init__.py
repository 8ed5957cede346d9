"""The folder of a command's results."""
