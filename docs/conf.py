"""Sphinx: the pages of this folder as HTML (`make docs`)."""

from __future__ import annotations

project = "mocap-gateway"
author = "the mocap-gateway authors"
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
# links to files beside the docs, all of which tests/test_links.py checks
suppress_warnings = ["myst.xref_missing"]
html_theme = "furo"
html_title = "mocap-gateway"
exclude_patterns = ["_build"]
