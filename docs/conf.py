"""Sphinx: the pages of this folder as HTML (`make docs`)."""

from __future__ import annotations

import re
from typing import Any

from docutils.nodes import SkipNode  # type: ignore[import-untyped]
from latex2mathml.converter import convert

project = "mocap-gateway"
author = "the mocap-gateway authors"
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
# links to files beside the docs, all of which tests/test_links.py checks
suppress_warnings = ["myst.xref_missing"]
html_theme = "furo"
html_title = "mocap-gateway"
html_math_renderer = "mathml"
exclude_patterns = ["_build"]

_NUMBER = re.compile(r"\\tag\{([^}]*)\}")


def _inline(translator: Any, node: Any) -> None:
    """Write a formula within a sentence."""
    translator.body.append(convert(node.astext()))
    raise SkipNode


def _displayed(translator: Any, node: Any) -> None:
    r"""Write a formula on a line of its own, at the right the number that ``\tag`` gives it: an anchor."""
    number = _NUMBER.search(node.astext())
    formula = convert(_NUMBER.sub("", node.astext()), display="block")
    label = "" if number is None else f'<span id="eq-{number[1]}">({number[1]})</span>'
    translator.body.append(
        '<div style="display: flex; align-items: center; overflow-x: auto; margin: 0.8em 0">'
        f'<div style="flex: 1">{formula}</div>{label}</div>\n'
    )
    raise SkipNode


def setup(app: Any) -> None:
    """Have formulas written as MathML, which browsers show without a script and without a network."""
    app.add_html_math_renderer("mathml", (_inline, None), (_displayed, None))
