"""Writes ``mocap_protocol.h``, the wire for firmware, from the declarations and the parts beside this file.

::

    python -m firmware_protocol.c.generate

The tests compare against the committed header, so that it cannot fall behind the declarations.
"""

from __future__ import annotations

from pathlib import Path

from firmware_protocol.c.catalogue import packets_source, settings_source, verbs_source
from firmware_protocol.c.constants import constants_source

FOLDER = Path(__file__).parent
HEADER = FOLDER / "mocap_protocol.h"


def header_source() -> str:
    """Return the whole header, in an order in which everything is declared before it is used."""
    sections = [
        _part("preamble"),
        constants_source(),
        _part("bytes"),
        _part("text"),
        _part("framing"),
        _part("signing"),
        packets_source(),
        _part("relay"),
        _part("can"),
        verbs_source(),
        _part("commands"),
        settings_source(),
        _part("flash"),
        _part("ending"),
    ]
    return "\n\n".join(section.strip() for section in sections) + "\n"


def _part(name: str) -> str:
    return (FOLDER / "parts" / f"{name}.h.in").read_text(encoding="utf-8")


if __name__ == "__main__":
    HEADER.write_text(header_source(), encoding="utf-8")
