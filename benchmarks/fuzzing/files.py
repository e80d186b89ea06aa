"""Inputs as files: where readers take a path, and what they may raise."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from devices.link import LinkError
from gateway.errors import GatewayError

SCRATCH = Path(tempfile.mkdtemp(prefix="mocap-fuzz-"))
MOST_LINES = 200
LONGEST_LINE = 2000


def in_a_file(name: str, data: bytes) -> Path:
    """A file of that name that holds the input."""
    path = SCRATCH / name
    path.write_bytes(data)
    return path


def refused_or_read(read: Callable[[], object]) -> None:
    """Reads; an input may be refused in a few lines, each short enough to be read by a person.

    Raises whatever else comes up, and ``AssertionError`` for a refusal that nobody would read.
    """
    try:
        read()
    except (GatewayError, LinkError) as error:
        lines = str(error).splitlines()
        assert lines, "a refusal without a word"
        assert len(lines) <= MOST_LINES, f"a refusal of {len(lines)} lines"
        longest = max(lines, key=len)
        assert len(longest) <= LONGEST_LINE, f"a line of {len(longest)} characters: {longest[:200]!r} …"
