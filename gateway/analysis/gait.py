"""When feet come down and lift off, by the floor's force on them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.analysis.floor import LEAST_FORCE_N, FloorForces, ForceSource
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray

_SHORTEST_STANCE_S = 0.1
_SHORTEST_SWING_S = 0.1
_LEAST_SHARE = 0.08
"""What lasts less is noise about the threshold."""


class GaitEvent(NamedTuple):
    """A foot that comes down or lifts off."""

    time_s: float
    foot: str
    event: str
    """``strike`` or ``off``."""
    source: str
    """Where the force came from: ``measured`` or ``estimated``."""


def gait_events(skeleton: Skeleton, floor: FloorForces, time_s: FloatArray) -> list[GaitEvent]:
    """Return strikes and offs in the order of time.

    A foot that stands when the motion begins or ends strikes or lifts off at no time
    that is known; so does one whose force before or after is not known."""
    found = []
    for c, segment in enumerate(floor.segments.tolist()):
        name = skeleton.segment_names[segment]
        for first, last in _stances(_loads(floor, c), time_s):
            source = ForceSource(int(floor.source[first, c])).name.lower()
            for frame, beside, event in ((first, first - 1, "strike"), (last, last + 1, "off")):
                is_inside = 0 <= beside < len(time_s)
                if is_inside and floor.source[beside, c] != ForceSource.UNKNOWN:
                    found.append(GaitEvent(float(time_s[frame]), name, event, source))
    return sorted(found)


def _loads(floor: FloorForces, foot: int) -> NDArray[np.bool_]:
    """Return (F,) whether a foot bears a load.

    An estimated force is the motion's need less what plates measured: a wrong mass leaves a little of it on a
    foot in the air, so it has to be a share of the largest.
    """
    up_n = floor.force[:, foot, 2]
    least = np.full(len(up_n), LEAST_FORCE_N)
    is_estimated = floor.source[:, foot] == ForceSource.ESTIMATED
    least[is_estimated] = max(LEAST_FORCE_N, _LEAST_SHARE * float(up_n.max(initial=0.0)))
    loaded: NDArray[np.bool_] = up_n > least
    return loaded


def _stances(stands: NDArray[np.bool_], time_s: FloatArray) -> list[tuple[int, int]]:
    """Return first and last frame of every load (F,), short breaks closed and short loads left out."""
    step = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    for value, shortest in ((False, _SHORTEST_SWING_S), (True, _SHORTEST_STANCE_S)):
        for first, last in _runs(stands == value):
            is_inside = first > 0 and last < len(stands) - 1
            if is_inside and (last - first + 1) * step < shortest:
                stands[first : last + 1] = not value
    return _runs(stands)


def _runs(mask: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> list[tuple[int, int]]:
    edges = np.diff(np.concatenate([[0], mask.astype(np.int8), [0]]))
    return list(
        zip(np.flatnonzero(edges == 1).tolist(), (np.flatnonzero(edges == -1) - 1).tolist(), strict=True)
    )
