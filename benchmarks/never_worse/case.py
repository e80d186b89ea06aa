"""One recording as it is judged: what a rig's modules measured, and the true orientations at the same
instants."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame

SCORED_AFTER_S = 5.0
"""Of a recording, at the least."""
MOVES_FROM = 0.5
"""rad/s of any module: from then on a motion can show headings."""
HEADINGS_WITHIN_S = 3.0
"""Of motion all headings shall be found: what comes later is scored."""
TURNED = np.radians(120.0)
"""rad: of a world that is turned; far from the headings that begin made up."""


@dataclass(frozen=True)
class Case:
    """A recording with its truth. T frames, S segments."""

    name: str
    kind: str
    """Recordings of one kind are averaged before kinds are."""
    suit: WornSuit
    interval_s: float
    frames: list[ImuFrame]
    truth: FloatArray  # (T, S, 4) q_wb at the frames; NaN where it is not known
    truth_later: FloatArray  # (T, S, 4) half a sample after them
    is_world_known: bool = False
    """Whether truth and rig have the same world and axes: nothing has to be taken out."""
    is_spatial: bool = True
    """Whether it moves about more than one axis, so that motion can show headings."""
    hinges: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    """Segment to the axis of its proximal joint, for peers that want it."""

    @property
    def times_s(self) -> FloatArray:
        """(T,) s since the first frame."""
        times = np.array([frame.time_ns for frame in self.frames], np.float64)
        return (times - times[0]) * 1e-9

    @property
    def forces(self) -> FloatArray:
        """(T, S, 3) measured specific forces, m/s², segment axes; every segment has a module."""
        rows = self.suit.module_of_segment
        measured = np.stack([frame.specific_force[rows] for frame in self.frames])
        q_sb = Rotation.from_quat(self.suit.sensor_to_segment, scalar_first=True)
        return np.stack([q_sb[s].apply(measured[:, s]) for s in range(len(rows))], axis=1)

    @property
    def moves_from_s(self) -> float:
        """When the motion begins, s; before that nothing can show a heading without a field."""
        rates = np.stack([frame.angular_rate for frame in self.frames])
        return float(self.times_s[int(np.argmax((np.linalg.norm(rates, axis=2) > MOVES_FROM).any(axis=1)))])

    @property
    def scored_after_s(self) -> float:
        """From when on errors count."""
        return max(SCORED_AFTER_S, self.moves_from_s + HEADINGS_WITHIN_S)

    @property
    def has_field(self) -> bool:
        """Whether any module gave a field."""
        return any(bool(np.isfinite(frame.magnetic_field).any()) for frame in self.frames[:20])

    @property
    def has_device(self) -> bool:
        """Whether a local device aids it."""
        return bool(self.suit.local_devices)

    @property
    def variants(self) -> tuple[Variant, ...]:
        """Every way to use what there is."""
        return tuple(
            Variant(has_device, has_field)
            for has_device in ((True, False) if self.has_device else (False,))
            for has_field in ((True, False) if self.has_field else (False,))
        )

    def suit_of(self, variant: Variant) -> WornSuit:
        """Return the rig, without its devices where they are not to be used."""
        return self.suit if variant.has_device else replace(self.suit, local_devices=())


@dataclass(frozen=True, order=True)
class Variant:
    """What of a recording is used."""

    has_device: bool
    has_field: bool

    def __str__(self) -> str:
        words = [word for word, has in (("device", self.has_device), ("field", self.has_field)) if has]
        return " + ".join(words) or "neither"


def in_turned_world(case: Case, name: str) -> Case:
    """Return a case in a world that is turned by ``TURNED`` about the vertical.

    What a body begins with is made up where no field shows it, and in some recordings happens to be right.
    """
    turn = Rotation.from_rotvec([0.0, 0.0, TURNED])

    def in_it(q_wb: FloatArray) -> FloatArray:
        found = np.full_like(q_wb, np.nan)
        known = np.isfinite(q_wb).all(axis=-1)
        found[known] = (turn * Rotation.from_quat(q_wb[known], scalar_first=True)).as_quat(scalar_first=True)
        return found

    def of(frame: ImuFrame) -> ImuFrame:
        local = (replace(reading, value=turn.apply(reading.value)) for reading in frame.local)
        return replace(frame, local=tuple(local))

    return replace(
        case, name=name, suit=replace(case.suit, magnetic_field=turn.apply(case.suit.magnetic_field)),
        frames=[of(frame) for frame in case.frames], truth=in_it(case.truth),
        truth_later=in_it(case.truth_later),
    )  # fmt: skip
