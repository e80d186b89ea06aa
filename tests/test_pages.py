"""Pages stay as long as somebody reads them."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_readme_is_short_has_one_moving_picture_and_no_figures():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.encode()) <= 7_000
    assert len(re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)) == 1
    assert "| figure |" not in text


def test_the_page_of_all_figures_can_be_read():
    assert len((ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8").splitlines()) <= 300


def test_every_page_is_in_the_contents():
    contents = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    folders = {path.parent.name for path in (ROOT / "docs").glob("*/*.md")} - {"_build"}
    assert not [
        name for name in sorted(folders) if f"{name}/*" not in contents and f"{name}/README" not in contents
    ]
