"""What a body calibration shows: bars while it runs, scores when it is done."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.table import Table
from rich.text import Text

from gateway.calibration.body_result import BodyResult
from gateway.calibration.body_session import BodySession, Liveliness
from gateway.calibration.control import STILL
from gateway.calibration.procedure import Kind, Step

_COLOURS = {"good": "green", "fair": "yellow", "poor": "red"}
_BAR = 20
_FULL_BAR = np.radians(120.0)


def live_table(session: BodySession, step: Step | None, live: Sequence[Liveliness]) -> Table:
    """A bar for every module: how fast it turns, and whether that is wanted now."""
    wants_rest = step is None or step.kind is Kind.POSE
    table = Table("module", "segment", "turning", "")
    for (module, segment), one in zip(modules_of(session), live, strict=True):
        is_still = one.turning < STILL
        if not one.is_heard:
            state, colour = "silent", "red"
        elif is_still:
            state, colour = "still", "green" if wants_rest else "white"
        else:
            state, colour = "moving", "red" if wants_rest else "green"
        full = min(round(_BAR * one.turning / _FULL_BAR), _BAR) if one.is_heard else 0
        bar = Text("█" * full + "░" * (_BAR - full) + f" {np.degrees(one.turning):4.0f} °/s", colour)
        table.add_row(str(module), segment.replace("_", " "), bar, Text(state, colour))
    return table


def modules_of(session: BodySession) -> list[tuple[int, str]]:
    """Module id and segment, in the order of the rig."""
    suit = session.suit
    segments = {
        int(row): name for row, name in zip(suit.module_of_segment, suit.skeleton.segment_names, strict=True)
    }
    return [(module, segments[row]) for row, module in enumerate(suit.module_ids)]


def result_table(result: BodyResult) -> Table:
    """A line a module: how good, how certain, and why not better."""
    table = Table("module", "segment", "quality", "orientation ±", "place ±", "why")
    for one in result.modules:
        quality = one.quality
        table.add_row(
            str(one.module),
            one.segment.replace("_", " "),
            Text(f"{quality.verdict} {quality.score:.2f}", _COLOURS[quality.verdict]),
            f"{np.degrees(one.rotation_sigma):.1f}°",
            f"{100 * one.position_sigma:.1f} cm",
            _reasons(quality.reasons),
        )
    return table


def _reasons(reasons: Sequence[str]) -> str:
    """The worst one; the others are counted, and told by ``--json``."""
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    return reasons[0] + more if reasons else ""
