"""Markers on a body: what an optical reconstruction needs to know of a person beforehand."""

from __future__ import annotations

from dataclasses import dataclass

from gateway.frames import FloatArray, IntArray


@dataclass(frozen=True)
class BodyMarkers:
    """Where every marker sits on its segment: the source's *virtual markers*."""

    labels: tuple[str, ...]
    """Names by which the optical system sends them."""
    segments: IntArray
    """(n_markers,) index of the segment that carries the marker."""
    positions: FloatArray
    """(n_markers, 3) from the segment's proximal joint, segment axes, m."""
    sigmas: FloatArray
    """(n_markers,) m: how far it strays from there, by skin and measurement; its weight is 1/σ²."""
    vertical: str = "z"
    """The axis of the optical system that points up: x, y or z."""
