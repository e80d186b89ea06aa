"""Markers of one instant as a line of JSON: what an optical system sends, and what recordings keep.

    {"sequence": 12, "time_s": 0.1, "markers": {"LASI": [0.1, 0.2, 0.9]}, "unlabelled": [[0.3, 0.1, 0.2]]}

``markers`` is wanted, all else may be left out. Lengths in m, or as ``unit`` says (m, cm, mm); a marker
that was
not seen is null or not there. ``time_s`` is of the sender's clock, ``time_ns`` of the gateway's (UTC). One
message a datagram, or one a line of a stream.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import orjson

from devices.link import Chunk
from devices.marker_files.trial import METRES

_LARGEST_M = 1000.0
_LONGEST_LINE = 1 << 20


@dataclass(frozen=True)
class MarkerMessage:
    """Markers as they came: axes of the optical system, m."""

    sequence: int
    time_ns: int
    """Gateway time."""
    markers: Mapping[str, tuple[float, float, float]]
    """Those that were seen."""
    unlabelled: tuple[tuple[float, float, float], ...]


def encode_markers(
    sequence: int,
    time_ns: int,
    labels: Sequence[str],
    positions: Sequence[Sequence[float]],
    unlabelled: Sequence[Sequence[float]] = (),
) -> bytes:
    """A message with its newline, every number in its shortest exact form; NaN positions are left out."""
    seen = {
        label: list(map(float, place))
        for label, place in zip(labels, positions, strict=True)
        if all(map(math.isfinite, place))
    }
    content: dict[str, Any] = {"sequence": sequence, "time_ns": time_ns, "markers": seen}
    nameless = [list(map(float, place)) for place in unlabelled if all(map(math.isfinite, place))]
    if nameless:
        content["unlabelled"] = nameless
    return orjson.dumps(content) + b"\n"


class _UnreadableError(Exception):
    """Of one message; its text is the reason that is counted."""


class MarkerReceiver:
    """Chunks of a link to messages. Never raises: what cannot be read is dropped, and counted by reason."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        """not_json, no_markers, bad_number, bad_unit, not_later, too_long."""
        self.received = 0
        self._rest = b""
        self._last_ns = -1
        self._offset_ns: int | None = None

    def receive(self, chunk: Chunk) -> list[MarkerMessage]:
        """The messages that a chunk completes, in time order."""
        *lines, self._rest = (self._rest + chunk.data).split(b"\n")
        if chunk.data == self._rest and _is_whole(self._rest):  # a datagram without newline
            lines, self._rest = [*lines, self._rest], b""
        if len(self._rest) > _LONGEST_LINE:
            self.dropped["too_long"] += 1
            self._rest = b""
        found = []
        for line in lines:
            if line.strip():
                try:
                    found.append(self._read(line, chunk.arrived_ns))
                except _UnreadableError as error:
                    self.dropped[str(error)] += 1
        return found

    def _read(self, line: bytes, arrived_ns: int) -> MarkerMessage:
        try:
            content = orjson.loads(line)
        except orjson.JSONDecodeError:
            raise _UnreadableError("not_json") from None
        if not isinstance(content, dict) or not isinstance(content.get("markers"), dict):
            raise _UnreadableError("no_markers")
        unit = content.get("unit", "m")
        factor = METRES.get(unit) if isinstance(unit, str) else None
        if factor is None:
            raise _UnreadableError("bad_unit")
        places = {
            name: _place(value, factor) for name, value in content["markers"].items() if value is not None
        }
        nameless = content.get("unlabelled") or []
        others = [_place(value, factor) for value in nameless] if isinstance(nameless, list) else [None]
        time_ns = self._time_ns(content, arrived_ns)
        sequence = content.get("sequence", self.received)
        if time_ns is None or not isinstance(sequence, int) or None in places.values() or None in others:
            raise _UnreadableError("bad_number")
        if time_ns <= self._last_ns:
            raise _UnreadableError("not_later")
        self._last_ns = time_ns
        self.received += 1
        seen = {name: place for name, place in places.items() if place is not None}
        return MarkerMessage(sequence, time_ns, seen, tuple(place for place in others if place is not None))

    def _time_ns(self, content: Mapping[str, Any], arrived_ns: int) -> int | None:
        """Gateway time of the instant. A sender's own clock is set by the least delayed message so far."""
        if "time_ns" in content:
            time_ns = content["time_ns"]
            return time_ns if isinstance(time_ns, int) and time_ns >= 0 else None
        if "time_s" not in content:
            return arrived_ns
        seconds = content["time_s"]
        if not isinstance(seconds, int | float) or not abs(seconds) < 1e11:
            return None
        sent_ns = round(seconds * 1e9)
        offset = arrived_ns - sent_ns
        self._offset_ns = offset if self._offset_ns is None else min(self._offset_ns, offset)
        return sent_ns + self._offset_ns


def _is_whole(text: bytes) -> bool:
    """Whether a message ends here: a piece of a stream may end with a brace too."""
    if not text.rstrip().endswith(b"}"):
        return False
    try:
        orjson.loads(text)
    except orjson.JSONDecodeError:
        return False
    return True


def _place(value: object, factor: float) -> tuple[float, float, float] | None:
    """Three numbers in m; None for anything else."""
    if not isinstance(value, list) or len(value) != 3:
        return None
    numbers = [
        float(each) * factor for each in value if isinstance(each, int | float) and not isinstance(each, bool)
    ]
    if len(numbers) != 3 or not all(abs(number) < _LARGEST_M for number in numbers):
        return None
    return numbers[0], numbers[1], numbers[2]
