"""Documentation as a site, by `make docs`: Markdown of docs, and pages of commands and modules read from the code."""
