"""What the page says, in each language: all of it stands in ``texts.json``."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

ENGLISH = "en"
LANGUAGES = {"English": ENGLISH, "Deutsch": "de"}
"""Name of a language in itself, and its texts."""
_FILE = Path(__file__).with_name("texts.json")


@cache
def texts(language: str) -> dict[str, str]:
    """Return all texts of a language, by key."""
    found: dict[str, str] = json.loads(_FILE.read_text(encoding="utf-8"))[language]
    return found


def segment_name(language: str, segment: str) -> str:
    """Return the name of a segment or joint for people; one without a text keeps its technical name."""
    return _name(language, "segment", segment)


def movement_name(language: str, movement: str) -> str:
    """Return the name of the movement in which an angle of a joint grows."""
    return _name(language, "angle", movement)


def step_name(language: str, step: str) -> str:
    """Return the name of a step of the body calibration."""
    return _name(language, "name", step)


def _name(language: str, kind: str, word: str) -> str:
    return texts(language).get(f"{kind}_{word}", word.replace("_", " "))


def translated(language: str, key: str, **values: object) -> str:
    """Return one text with its values filled in. Raises ``KeyError`` for an unknown one."""
    return texts(language)[key].format(**values)
