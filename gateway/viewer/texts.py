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
    """All texts of a language, by key."""
    found: dict[str, str] = json.loads(_FILE.read_text(encoding="utf-8"))[language]
    return found


def segment_name(language: str, segment: str) -> str:
    """A segment or joint as it is told to people; one that no text names as its body names it."""
    return _name(language, "segment", segment)


def movement_name(language: str, movement: str) -> str:
    """The movement in which an angle of a joint grows, likewise."""
    return _name(language, "angle", movement)


def step_name(language: str, step: str) -> str:
    """A step of the body calibration, likewise."""
    return _name(language, "name", step)


def _name(language: str, kind: str, word: str) -> str:
    return texts(language).get(f"{kind}_{word}", word.replace("_", " "))


def say(language: str, key: str, **values: object) -> str:
    """One text with its values filled in. Raises ``KeyError`` for an unknown one."""
    return texts(language)[key].format(**values)
