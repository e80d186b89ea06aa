"""Markers of one instant as a line of JSON: what an optical system sends, and what recordings keep.

    {"sequence": 12, "time_s": 0.1, "markers": {"LASI": [0.1, 0.2, 0.9]}, "unlabelled": [[0.3, 0.1, 0.2]]}

``markers`` is wanted, all else may be left out. Lengths in m, or as ``unit`` says (m, cm, mm); a marker
that was not seen is null or not there. ``up`` is the axis of the system that points up (x, y, z). ``time_s``
is of the sender's clock, ``time_ns`` of the gateway's (UTC). One message a datagram, or one a line of a
stream.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import orjson

from devices.link import Chunk
from devices.marker_files.trial import metres_of

_LARGEST_M = 1000.0
_LONGEST_LINE = 1 << 20
_AXES = frozenset({"x", "y", "z", "-x", "-y", "-z"})
_FASTEST_DRIFT = 200e-6
"""How much faster than the gateway's a sender's clock may run, or slower: crystals are within 100 ppm."""
_RESTART_NS = 250_000_000
"""A sender's clock that falls back by more counts from anew; by less, a datagram may have been overtaken."""


@dataclass(frozen=True)
class MarkerMessage:
    """Markers as they came: axes of the optical system, m."""

    sequence: int
    time_ns: int
    """Gateway time."""
    markers: Mapping[str, tuple[float, float, float]]
    """Those that were seen."""
    unlabelled: tuple[tuple[float, float, float], ...]
    up: str | None = None
    """The axis of the optical system that points up, x, y or z; None: the message does not say."""


def encode_markers(
    sequence: int,
    time_ns: int | None,
    labels: Sequence[str],
    positions: Sequence[Sequence[float]],
    unlabelled: Sequence[Sequence[float]] = (),
    *,
    time_s: float | None = None,
    up: str | None = None,
) -> bytes:
    """Return a message with its newline, every number in its shortest exact form; NaN positions are left out.

    time_ns: of the gateway's clock; None: ``time_s`` of the sender's, if any. Positions in m.
    """
    seen = {
        label: list(map(float, place))
        for label, place in zip(labels, positions, strict=True)
        if all(map(math.isfinite, place))
    }
    fields = {"sequence": sequence, "time_ns": time_ns, "time_s": time_s, "up": up}
    content: dict[str, Any] = {name: value for name, value in fields.items() if value is not None}
    content["markers"] = seen
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
        """not_json, no_markers, bad_number, bad_unit, bad_up, not_later, too_long."""
        self.received = 0
        self._rest = b""
        self._last_ns = -1
        self._clock = SenderClock()

    def receive(self, chunk: Chunk) -> list[MarkerMessage]:
        """Return the messages that a chunk completes, in order of time."""
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
        factor = metres_of(unit) if isinstance(unit, str) else None
        if factor is None:
            raise _UnreadableError("bad_unit")
        up = content.get("up")
        if up is not None and not (isinstance(up, str) and up in _AXES):
            raise _UnreadableError("bad_up")
        places = {
            name: _place(value, factor) for name, value in content["markers"].items() if value is not None
        }
        nameless = content.get("unlabelled") or []
        others = [_place(value, factor) for value in nameless] if isinstance(nameless, list) else [None]

        sequence = content.get("sequence", self.received)
        if not isinstance(sequence, int):
            raise _UnreadableError("bad_number")
        time_ns = self._time_ns(content, arrived_ns)
        if time_ns is None or None in places.values() or None in others:
            raise _UnreadableError("bad_number")
        # Two messages of one instant, or a sender that was restarted: time must not go back.
        if time_ns <= self._last_ns:
            raise _UnreadableError("not_later")
        self._last_ns = time_ns
        self.received += 1
        seen = {name: place for name, place in places.items() if place is not None}
        return MarkerMessage(
            sequence, time_ns, seen, tuple(place for place in others if place is not None), up
        )

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
        return self._clock.gateway_time(round(seconds * 1e9), arrived_ns, content.get("sequence"))


class SenderClock:
    """A sender's clock, set by its least delayed messages.

    The offset is the least of arrival minus sending time, and may grow by no more than two crystals drift
    apart: in an hour 50 ppm would else make 180 ms. A clock that falls back by a quarter of a second counts
    from anew.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._sent_ns = 0
        self._sequence = 0

    def gateway_time(self, sent_ns: int, arrived_ns: int, sequence: int | None) -> int:
        """Gateway time of an instant of the sender's, which is never later than its arrival, ns.

        sequence: the message's number, if it has one: no later an instant with a later number is of a clock
        that counts from anew.
        """
        offset, elapsed = arrived_ns - sent_ns, sent_ns - self._sent_ns
        is_later = sequence is not None and sequence > self._sequence
        # A clock that was set back, or that repeats times under newer numbers, was started anew.
        if self._offset_ns is None or elapsed < -_RESTART_NS or (elapsed <= 0 and is_later):
            self._offset_ns, self._sent_ns = offset, sent_ns
        # The least delayed message sets the offset, which may grow as fast as the worst clock drifts.
        self._offset_ns = min(self._offset_ns + round(_FASTEST_DRIFT * max(elapsed, 0)), offset)
        self._sent_ns = max(sent_ns, self._sent_ns)
        self._sequence = self._sequence if sequence is None else max(sequence, self._sequence)
        return sent_ns + self._offset_ns


def _is_whole(text: bytes) -> bool:
    """Return whether a message ends here: a piece of a stream may end with a brace too."""
    if not text.rstrip().endswith(b"}"):
        return False
    try:
        orjson.loads(text)
    except orjson.JSONDecodeError:
        return False
    return True


def _place(value: object, factor: float) -> tuple[float, float, float] | None:
    """Return three numbers in m; None for anything else."""
    if not isinstance(value, list) or len(value) != 3:
        return None
    numbers = [
        float(each) * factor for each in value if isinstance(each, int | float) and not isinstance(each, bool)
    ]
    if len(numbers) != 3 or not all(abs(number) < _LARGEST_M for number in numbers):
        return None
    return numbers[0], numbers[1], numbers[2]
