"""How the words of the declarations are spelt in C."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping

from firmware_protocol.fields import INTEGER_RANGE, TYPE_NAMES, WireField

PREFIX = "mocap"

C_TYPES: Mapping[str, str] = {
    "B": "uint8_t",
    "b": "int8_t",
    "H": "uint16_t",
    "h": "int16_t",
    "I": "uint32_t",
    "i": "int32_t",
    "Q": "uint64_t",
    "f": "float",
    "s": "uint8_t",
}
"""C type of one element of each layout code."""

# Compilers for small processors do not all read UTF-8, so comments keep to ASCII.
_ASCII = {
    "²": "^2",
    "³": "^3",
    "µ": "u",
    "°C": "degC",
    "°": " deg",
    "×": "x",
    "–": "-",
    "−": "-",
    "±": "+-",
    "σ": "sigma",
    "é": "e",
}

_COMMENT_WIDTH = 104
_LINE_WIDTH = 110


def ascii_text(text: str) -> str:
    """Return text in ASCII. Raises ValueError for a character that has no spelling."""
    for letter, spelling in _ASCII.items():
        text = text.replace(letter, spelling)
    if not text.isascii():
        raise ValueError(f"no ASCII spelling for {[c for c in text if not c.isascii()]} of {text!r}")
    return text


def snake(name: str) -> str:
    """Return ``inertial_sample`` for ``InertialSample``; ``read_setting`` for ``READ_SETTING``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def c_name(*words: str) -> str:
    """Return a name of the header: ``mocap_inertial_sample``."""
    return "_".join((PREFIX, *map(snake, words)))


def macro_name(*words: str) -> str:
    """Return a constant of the header: ``MOCAP_KIND_HEALTH``."""
    return c_name(*words).upper()


def slug(meaning: str) -> str:
    """Return the name of a constant from the first words of what it stands for."""
    head = re.split(r"[,;:(.]", ascii_text(meaning))[0]
    return re.sub(r"\W+", "_", head.strip()).upper()


def comment(text: str, indent: str = "") -> str:
    """Return a block comment, wrapped."""
    width = _COMMENT_WIDTH - len(indent)
    lines = textwrap.wrap(ascii_text(text), width=width - 6, break_on_hyphens=False)
    return f"{indent}/* " + f"\n{indent} * ".join(lines) + " */"


def heading(text: str) -> str:
    """Return the line above a section of the header."""
    return f"/* ---- {text} ".ljust(_COMMENT_WIDTH - 3, "-") + " */"


def type_suffix(declared: WireField) -> str:
    """Return what the functions for one element end in: ``i16``."""
    return TYPE_NAMES[declared.code]


def literal(number: int, code: str) -> str:
    """Return an integer constant of the layout code's type that every C compiler takes without a warning."""
    if code in INTEGER_RANGE and INTEGER_RANGE[code][0] < 0:
        return f"(-{-number - 1} - 1)" if number == -(2**31) else str(number)
    return f"{number}ull" if number >= 2**32 else f"{number}u"


def define(name: str, value: str, note: str = "") -> str:
    """Return a constant with what it stands for."""
    line = f"#define {name} {value}"
    beside = f"{line} /* {ascii_text(note)} */" if note else line
    return beside if len(beside) <= _LINE_WIDTH else f"{comment(note)}\n{line}"


def wrapped(line: str) -> list[str]:
    """Return a line of code, cut at spaces where it is too long."""
    if len(line) <= _LINE_WIDTH:
        return [line]
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.wrap(
        line.strip(),
        width=_LINE_WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + " " * 8,
        break_long_words=False,
        break_on_hyphens=False,
    )
