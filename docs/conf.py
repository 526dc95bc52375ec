"""Sphinx reads the Markdown of this folder: `make docs`."""

project = "rfsg"
extensions = ["myst_parser"]
root_doc = "index"
html_theme = "pydata_sphinx_theme"
myst_heading_anchors = 3
suppress_warnings = ["myst.xref_missing"]  # files outside docs/ are named, not linked
