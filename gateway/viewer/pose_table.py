"""Poses of one gateway as a table for the terminal."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from rich.table import Table
from rich.text import Text

from gateway.contract.messages import PoseMessage, Quaternion
from gateway.outputs.subscriber import ReceivedPose
from gateway.support.names import printable

STALE_AFTER_S = 1.0
"""Age of the last pose from which on the table says that no data comes."""

_WINDOW_NS = 2_000_000_000
"""Rate and latency are those of the last so many nanoseconds."""

_LEAST_SPAN_NS = 250_000_000
"""No rate is shown of fewer: the first poses may come in a burst."""

_STATUS_COLOURS = {
    "measured": "green",
    "interpolated": "cyan",
    "held": "yellow",
    "predicted": "magenta",
    "warming_up": "blue",
    "missing": "red",
    "unaided": "yellow",
    "doubtful": "red",
}
_UNDEFINED = "–"


class Attitude(NamedTuple):
    """Orientation of a segment against upright standing, degrees."""

    heading_deg: float
    """Compass direction of the anterior axis: 0 north, 90 east; in [0, 360)."""
    pitch_deg: float
    """Elevation of the anterior axis."""
    roll_deg: float
    """About the anterior axis; positive lowers the right side."""


def attitude(q_wb: Quaternion) -> Attitude:
    """Return Cardan angles (z, y', x'') of a segment with ISB axes: x anterior, y superior, z to the
    right."""
    w, x, y, z = q_wb
    anterior = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    superior_up = 2 * (y * z + w * x)
    right_up = 1 - 2 * (x * x + y * y)
    return Attitude(
        heading_deg=math.degrees(math.atan2(anterior[0], anterior[1])) % 360.0,
        # Rounded numbers may lie just outside of what asin takes.
        pitch_deg=math.degrees(math.asin(max(-1.0, min(1.0, anterior[2])))),
        roll_deg=math.degrees(math.atan2(-right_up, superior_up)),
    )


def bend_deg(parent: Quaternion | None, child: Quaternion | None) -> float:
    """Return the angle of a segment against its parent, °, 0 in the neutral posture; NaN if unknown."""
    if parent is None or child is None:
        return float("nan")
    along = abs(sum(p * c for p, c in zip(parent, child, strict=True)))
    return math.degrees(2.0 * math.acos(min(1.0, along)))


class PoseView:
    """The last pose of one gateway, with the rate and latency of those before it."""

    def __init__(self, gateway: str) -> None:
        self.gateway = gateway
        self.last: ReceivedPose | None = None
        self._recent: deque[tuple[int, float]] = deque()  # received_ns, latency_s

    def add(self, received: ReceivedPose) -> None:
        """Note a pose, for the rate and latency of the last seconds."""
        self.last = received
        self._recent.append((received.received_ns, received.latency_s))
        while self._recent[0][0] < received.received_ns - _WINDOW_NS:
            self._recent.popleft()

    @property
    def rate_hz(self) -> float | None:
        """Poses a second; None before they span ``_LEAST_SPAN_NS``."""
        span_ns = self._recent[-1][0] - self._recent[0][0] if self._recent else 0
        return (len(self._recent) - 1) * 1e9 / span_ns if span_ns >= _LEAST_SPAN_NS else None

    @property
    def latency_s(self) -> float | None:
        """Median latency; None before the first pose."""
        latencies = sorted(latency for _, latency in self._recent)
        return latencies[len(latencies) // 2] if latencies else None

    def age_s(self, now_ns: int) -> float | None:
        """Return the time since the last pose came; None before the first."""
        return None if self.last is None else (now_ns - self.last.received_ns) * 1e-9

    def table(self, now_ns: int, state: str, with_quaternions: bool = False) -> Table:
        """Return a table of everything known about this gateway, as of ``now_ns``."""
        table = Table(title=self.headline(now_ns, state), title_justify="left", title_style="")
        table.add_column("segment")
        columns = ("w", "x", "y", "z") if with_quaternions else ("heading °", "pitch °", "roll °")
        for column in columns:
            table.add_column(column, justify="right", min_width=8)
        table.add_column("status")
        if self.last is not None:
            _add_rows(table, self.last.pose, with_quaternions)
        return table

    def headline(self, now_ns: int, state: str) -> Text:
        """Return name, state, rate, latency and age in one line."""
        colour = {"online": "green", "offline": "red"}.get(state, "yellow")
        headline = Text.assemble((printable(self.gateway), "bold"), "  ", (state, colour))
        age = self.age_s(now_ns)
        if age is None:
            headline.append("  no pose yet", "yellow")
        elif age > STALE_AFTER_S:
            headline.append(f"  no data for {age:.0f} s", "bold red")
        else:
            rate, latency = self.rate_hz, self.latency_s
            headline.append(f"  {rate:.1f} Hz" if rate is not None else "")
            headline.append(f"  latency {latency * 1e3:.1f} ms" if latency is not None else "")
            headline.append(f"  age {age * 1e3:.0f} ms")
        return headline


def _plain(name: str) -> Text:
    """Return a name as plain text, neither obeyed by the terminal nor taken for markup."""
    return Text(printable(name))


def joint_table(pose: PoseMessage) -> Table | None:
    """Return the joint angles of a pose; None when it carries none."""
    if not pose.joint_angles:
        return None
    table = Table("joint", "angles °", "")
    warnings = pose.joint_warnings or {}
    for joint, angles in pose.joint_angles.items():
        shown = "  ".join(f"{name.replace('_', ' ')} {value:7.1f}" for name, value in (angles or {}).items())
        words = ", ".join(warnings.get(joint, ())).replace("_", " ")
        table.add_row(*map(_plain, (joint, shown or _UNDEFINED)), Text(printable(words), "yellow"))
    return table


def _add_rows(table: Table, pose: PoseMessage, with_quaternions: bool) -> None:
    for segment, q_wb in pose.segments.items():
        if q_wb is None:
            cells = [_UNDEFINED] * (4 if with_quaternions else 3)
        elif with_quaternions:
            cells = [f"{component:.4f}" for component in q_wb]
        else:
            cells = [f"{angle:.1f}" for angle in attitude(q_wb)]
        status = pose.status.get(segment, "missing")
        name = f"{segment} (root)" if segment == pose.root else segment
        table.add_row(_plain(name), *cells, Text(status.replace("_", " "), _STATUS_COLOURS[status]))
