"""The suit of an imported recording: a shipped body, no larger than what is worn, and its alignment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from devices.deferred import Rotation
from devices.recorded_tracks import LocalTrack
from firmware_protocol.samples import STANDARD_GRAVITY
from gateway.body.body_file import load_body
from gateway.body.skeleton import LocalDevice, WornSuit, field_vector, reduced
from gateway.errors import GatewayError
from gateway.frames import FloatArray, Quantity
from gateway.geometry import quaternion
from gateway.imports.segment_names import BODY
from gateway.recording import SkeletonArrays

_DIP_DEG = 65.0
_FIELD_UT = 50.0


def dressed(
    segments: Mapping[int, str],
    local: Sequence[LocalTrack] = (),
    body: str | None = None,
    *,
    mvn_axes: bool = False,
) -> WornSuit:
    """Return the suit of a recording.

    segments: by module id. body: name or file; None: a person. mvn_axes: modules are segments in the axes of
    MVN (x forward, y left, z up) instead of modules of which nothing is known.
    """
    skeleton = load_body(body or BODY)
    skeleton = reduced(skeleton, [skeleton.index(name) for name in segments.values()])
    n, ids = skeleton.n_segments, tuple(segments)
    rows = np.full(n, -1, dtype=np.int64)
    for row, segment in enumerate(segments.values()):
        rows[skeleton.index(segment)] = row
    alignment = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    if mvn_axes:
        alignment[rows >= 0] = quaternion.conjugate(skeleton.neutral)
    devices = tuple(LocalDevice(Quantity(track.quantity), 0, np.zeros(3), track.module) for track in local)
    return WornSuit(
        skeleton=skeleton,
        module_ids=ids,
        module_of_segment=rows,
        sensor_to_segment=alignment,
        lever_arms=np.zeros((n, 3)),
        local_devices=devices,
        gravity=np.array([0.0, 0.0, -STANDARD_GRAVITY]),
        magnetic_field=field_vector(_FIELD_UT, _DIP_DEG),
    )


def aligned(
    suit: WornSuit, seen: SkeletonArrays, start_s: float, end_s: float, forward: str | None
) -> WornSuit:
    """Return the suit whose wearer stood in the neutral posture from ``start_s`` to ``end_s``.

    seen: poses solved with the suit as it was. forward: axis of the root's module that pointed to where the
    person looked (``x``, ``-z`` …), None: the person looked east. Raises ``GatewayError``.
    """
    rows = np.flatnonzero((seen.time_s >= start_s) & (seen.time_s <= end_s))
    if not len(rows):
        raise GatewayError(
            f"--neutral {start_s:g}:{end_s:g}: the recording lasts from 0 to {seen.time_s[-1]:.1f} s"
        )
    carried = np.flatnonzero(suit.module_of_segment >= 0)
    neutral = Rotation.from_quat(suit.skeleton.neutral, scalar_first=True)
    means = {s: _mean(suit, seen.q_wb[rows, s], s) for s in carried.tolist()}
    heading = _heading(means[int(carried[0])], forward)
    alignment = suit.sensor_to_segment.copy()
    for segment, q_ws in means.items():
        alignment[segment] = ((heading * neutral).inv() * q_ws).as_quat(canonical=True, scalar_first=True)
    return replace(suit, sensor_to_segment=alignment)


def _mean(suit: WornSuit, q_wb: FloatArray, segment: int) -> Rotation:
    """Return ``q_ws`` of a module over some frames. Raises ``GatewayError`` when it was never known."""
    known = q_wb[np.isfinite(q_wb[:, 0])]
    if not len(known):
        name = suit.skeleton.segment_names[segment]
        raise GatewayError(f"--neutral: {name} has no orientation in that time; choose another")
    q_bs = Rotation.from_quat(suit.sensor_to_segment[segment], scalar_first=True)
    return Rotation.from_quat(known, scalar_first=True).mean() * q_bs


def _heading(q_ws: Rotation, forward: str | None) -> Rotation:
    """Turn about the vertical from east to where the person looked."""
    if forward is None:
        return Rotation.identity()
    axis = np.eye(3)["xyz".index(forward[-1])] * (-1.0 if forward.startswith("-") else 1.0)
    east, north, _up = q_ws.apply(axis)
    if np.hypot(east, north) < 0.3:
        raise GatewayError(f"--forward {forward}: that axis of the module points up or down, not forward")
    return Rotation.from_euler("z", np.arctan2(north, east))
