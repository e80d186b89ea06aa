"""The articulated body that wears the emulated suit, as plain data passed by the caller."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NO_MODULE = -1
"""In ``EmulatedBody.module_ids``: the segment carries no module."""

NO_PARENT = -1


@dataclass(frozen=True)
class EmulatedLocalDevice:
    """A local measuring device (ML): it measures the motion of one of its segment's points in the world."""

    module: int
    """Module id it sends under."""
    segment: int
    """Index of the segment it sits on."""
    position: FloatArray
    """(3,) from the segment's proximal joint, segment axes, m."""
    quantity: int
    """As on the wire: 1 acceleration (m/s²), 2 velocity (m/s), 3 position (m); 4: velocity by pressure tubes
    in still air."""
    sigma: float = 0.0
    """Standard deviation of the noise of each component, in the quantity's unit (pressure tubes: Pa). Also
    what it claims."""
    rate_hz: float = 30.0
    orientation: FloatArray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    """(4,) ``q`` device axes to segment axes, of pressure tubes."""


@dataclass(frozen=True)
class EmulatedBody:
    """Rigid segments joined in a tree, with modules strapped to them.

    Build one with ``emulated_body``, which fills in what is left out and checks the shapes.
    """

    segment_names: tuple[str, ...]
    parents: IntArray
    """(S,) index of the parent segment, -1 for the root; parents come first."""
    offsets: FloatArray
    """(S, 3) the segment's proximal joint in its parent's axes, m. Zero for the root."""
    module_positions: FloatArray
    """(S, 3) lever arm ``U``: proximal joint to module, segment axes, m."""
    sensor_to_segment: FloatArray
    """(S, 4) ``q_bs``, unit, wxyz."""
    module_ids: IntArray
    """(S,) module worn by the segment, ``NO_MODULE`` for none."""
    reference_posture: FloatArray
    """(S, 4) ``q_wb`` of every segment when all joint angles are zero, unit, wxyz."""
    local_devices: tuple[EmulatedLocalDevice, ...] = field(default=())
    contacts: tuple[tuple[int, FloatArray], ...] = field(default=())
    """Points that touch the ground: segment, and (3,) from its proximal joint, segment axes, m."""

    @property
    def n_segments(self) -> int:
        """How many segments it has."""
        return len(self.segment_names)

    def path(self, segment: int) -> list[int]:
        """Return the indices of the segments from the root to this one, both included."""
        path = [segment]
        while (parent := int(self.parents[path[0]])) != NO_PARENT:
            path.insert(0, parent)
        return path


def emulated_body(
    segment_names: tuple[str, ...],
    parents: ArrayLike,
    offsets: ArrayLike,
    *,
    module_positions: ArrayLike | None = None,
    sensor_to_segment: ArrayLike | None = None,
    module_ids: ArrayLike | None = None,
    reference_posture: ArrayLike | None = None,
    local_devices: tuple[EmulatedLocalDevice, ...] = (),
    contacts: tuple[tuple[int, FloatArray], ...] = (),
) -> EmulatedBody:
    """Return a checked ``EmulatedBody``.

    Left out: modules sit on the joints, sensor axes are the segment's, modules are numbered as the
    segments are, and the reference posture is the identity. Raises ``ValueError`` where shapes or the
    order of the parents are wrong.
    """
    n = len(segment_names)
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    body = EmulatedBody(
        segment_names=tuple(segment_names),
        parents=np.asarray(parents, dtype=np.int64),
        offsets=np.asarray(offsets, dtype=float),
        module_positions=_or_default(module_positions, np.zeros((n, 3))),
        sensor_to_segment=_unit(_or_default(sensor_to_segment, identity)),
        module_ids=np.asarray(np.arange(n) if module_ids is None else module_ids, dtype=np.int64),
        reference_posture=_unit(_or_default(reference_posture, identity)),
        local_devices=tuple(local_devices),
        contacts=tuple(contacts),
    )
    _check(body)
    return body


def _or_default(given: ArrayLike | None, default: FloatArray) -> FloatArray:
    return default if given is None else np.asarray(given, dtype=float)


def _unit(q: FloatArray) -> FloatArray:
    unit: FloatArray = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return unit


def _check(body: EmulatedBody) -> None:
    n = body.n_segments
    shapes = {
        "parents": (n,),
        "offsets": (n, 3),
        "module_positions": (n, 3),
        "sensor_to_segment": (n, 4),
        "module_ids": (n,),
        "reference_posture": (n, 4),
    }
    for name, expected in shapes.items():
        found = getattr(body, name).shape
        if found != expected:
            raise ValueError(f"{name} has shape {found}; a body of {n} segments needs {expected}")
    for segment, parent in enumerate(body.parents):
        if not NO_PARENT <= parent < segment:
            raise ValueError(
                f"segment {body.segment_names[segment]!r} has parent {parent}; "
                "parents must come before their children, -1 for a root"
            )
    worn = [int(i) for i in body.module_ids if i != NO_MODULE] + [d.module for d in body.local_devices]
    if len(set(worn)) != len(worn):
        raise ValueError(f"module ids are given twice among {sorted(worn)}; each module needs its own")
