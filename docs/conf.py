"""Sphinx reads the Markdown of this folder: `make docs`."""

project = "rfsg"
extensions = ["myst_parser"]
root_doc = "index"
html_theme = "pydata_sphinx_theme"
myst_heading_anchors = 3
suppress_warnings = ["myst.xref_missing", "toc.not_included"]  # index.md is the table of contents
