"""The reference pages are those that the program declares now."""

from __future__ import annotations

import pytest

from benchmarks.reference import FOLDER, pages


@pytest.mark.parametrize(("name", "text"), pages().items())
def test_a_page_is_up_to_date(name, text):
    assert (FOLDER / name).read_text(encoding="utf-8") == text, "run: python -m benchmarks.reference"
