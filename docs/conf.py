"""Settings of Sphinx, which `make docs` runs."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]

project = "bodyseg"
html_show_copyright = False
extensions = ["myst_parser", "sphinx.ext.autodoc", "benches.site.extension"]
exclude_patterns = ["_build", "results/*.md.in", "**/.ipynb_checkpoints"]

myst_heading_anchors = 4
smartquotes = False  # two hyphens begin an option
default_role = "literal"

autodoc_default_options = {"members": True, "member-order": "bysource", "show-inheritance": True, "no-value": True}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
add_module_names = False
python_maximum_signature_line_length = 88
toc_object_entries = False
suppress_warnings = ["ref.python"]  # annotations name classes without their modules, and two have one name

html_theme = "furo"
html_title = "bodyseg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
