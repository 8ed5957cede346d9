"""Documentation as a site: `make docs`. Its pages are the Markdown files of docs; commands and modules are read from the code."""
