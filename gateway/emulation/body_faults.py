"""What befalls the body's sensors, and what `joint` makes of it: an emulated suit through the wire.

Every case is the same walk of the same person with the same noise; it is compared, instant by instant, with
the run in which nothing went wrong. *excess*: error less the error of that run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from devices.emulators.bodies import EmulatedBody
from devices.emulators.faults.fault_plan import FaultPlan
from devices.emulators.faults.faulty_suit import FaultySuit
from devices.emulators.imperfections import TYPICAL
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.body.skeleton import LocalDevice, WornSuit
from gateway.emulation.rig import LOCAL_SIGMA, dress, move, worn_wrong
from gateway.frames import FloatArray, Quantity, Status, StatusArray
from gateway.geometry import quaternion
from gateway.geometry.comparison import orientation_error
from gateway.pipeline import Pipeline
from gateway.stages.frame_assembler import AssemblyParams

BEGIN_S, SECONDS, LONG_SECONDS = 12.0, 32.0, 84.0
VICTIM, ML = 12, 60
"""Module on the left shank, and the device that measures the pelvis' position."""
VICTIM_SEGMENT = "left_shank"
RECOVERED_DEG = 1.0
STEP_S = 0.05
LINK = "suit"


@dataclass(frozen=True)
class Case:
    """Something that goes wrong, and for how long."""

    name: str
    fault: dict[str, Any] | None = None
    """Without the times; see ``fault_plan``."""
    lasts_s: float = 1000.0
    """To the end of the run, if longer than that."""
    begins_s: float = BEGIN_S
    worn: str = ""
    """``turned``, ``upside_down``, ``swapped`` (with the foot's) or ``swapped_shanks``: how the victim is
    worn, throughout."""
    seconds: float = SECONDS

    @property
    def ends_s(self) -> float:
        """When the fault ends, s."""
        return self.begins_s + self.lasts_s

    @property
    def worn_wrong(self) -> tuple[str, ...]:
        """The segments whose modules are worn wrong."""
        if not self.worn:
            return ()
        return (VICTIM_SEGMENT, *([_SWAPPED_WITH[self.worn]] if self.worn in _SWAPPED_WITH else []))

    def plan(self) -> FaultPlan:
        """Return what befalls the emulated suit."""
        times = {"at": self.begins_s, "lasts": self.lasts_s}
        return FaultPlan.model_validate({"faults": [self.fault | times] if self.fault else []})


def _module(kind: str, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "module": VICTIM, **more}


MODULE_CASES = (
    Case("module dies", _module("reset")),
    Case("module dies, comes back after 10 s", _module("reset"), 10.0),
    Case("module worn turned by 180° about the leg", worn="turned"),
    Case("module worn upside down", worn="upside_down"),
    Case("module and that of the foot swapped", worn="swapped"),
    Case("modules of both shanks swapped", worn="swapped_shanks"),
    Case("gyroscope saturated for 2 s", _module("saturated"), 2.0),
    Case("accelerometer saturated for 2 s", _module("saturated", sensor="specific_force"), 2.0),
    Case("gyroscope stuck for 5 s", _module("stuck"), 5.0),
    Case("magnet of 60 µT passes for 5 s", _module("magnet"), 5.0),
)
ML_CASES = tuple(
    Case(
        f"local device silent for {lasts_s:g} s",
        {"kind": "reset", "module": ML},
        lasts_s,
        seconds=max(SECONDS, BEGIN_S + lasts_s + 15.0),
    )
    for lasts_s in (0.5, 5.0, 60.0)
)


@dataclass(frozen=True)
class Run:
    """What came out of one case, T frames of n segments."""

    case: Case
    times_s: FloatArray  # (T,)
    error_deg: FloatArray  # (T, n)
    tilt_deg: FloatArray  # (T, n)
    q_wb: FloatArray  # (T, n, 4)
    p_w: FloatArray  # (T, n, 3)
    true_p_w: FloatArray  # (T, n, 3)
    sigma_deg: FloatArray  # (T, n)
    status: StatusArray  # (T, n)
    agreement: dict[str, float]
    doubts: dict[int, str]
    """By module at the end, why its segment is doubtful."""


def suit_with_position() -> WornSuit:
    """Return the shipped suit for the lower body with a device at its waist that measures its place."""
    suit = load_rig("suit_lower_7")
    device = LocalDevice(Quantity.POSITION, suit.skeleton.index("pelvis"), np.array([0.0, 0.1, 0.0]), ML)
    return replace(suit, local_devices=(device,))


def emulated(suit: WornSuit, case: Case, method: str = "joint", seed: int = 1) -> Run:
    """Return the run of one case through bytes, clocks and frames."""
    truth = move(dress(suit, LOCAL_SIGMA), suit.skeleton.name, seed)
    motion = truth
    # The truth is of a body that wears its modules as the rig says; what is sent is of one that does not.
    if case.worn:
        motion = move(_worn(dress(suit, LOCAL_SIGMA), case.worn), suit.skeleton.name, seed)
    settings = SuitSettings(gravity=suit.gravity, magnetic_field=suit.magnetic_field)
    traffic = FaultySuit(SuitTraffic(motion, settings, TYPICAL, seed), case.plan())
    pipeline = Pipeline(suit, AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000), method)
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    steps = range(1, round(case.seconds / STEP_S) + 1)
    frames = list(
        pipeline.replay(
            Chunk(sent.data, round(sent.time_s * 1e9), LINK)
            for step in steps
            for sent in traffic.advance(step * STEP_S)
        )
    )
    times_s = np.array([frame.time_ns for frame in frames]) * 1e-9
    q_wb, state = np.stack([frame.q_wb for frame in frames]), truth.state(times_s)
    error = orientation_error(q_wb, state.q_wb)
    statistics: Any = pipeline.statistics()
    return Run(
        case=case,
        times_s=times_s,
        error_deg=np.degrees(error.total),
        tilt_deg=np.degrees(error.inclination),
        q_wb=q_wb,
        p_w=np.stack([frame.p_w for frame in frames]),
        true_p_w=state.joint_position,
        sigma_deg=np.degrees(np.stack([frame.sigma for frame in frames])),
        status=np.stack([frame.status for frame in frames]),
        agreement=statistics["joint_agreement"],
        doubts={int(module): why for module, why in statistics["doubts"].items()},
    )


_ABOUT_THE_LEG = np.array([0.0, 0.0, 1.0, 0.0])
_SWAPPED_WITH = {"swapped": "left_foot", "swapped_shanks": "right_shank"}


def _worn(body: EmulatedBody, how: str) -> EmulatedBody:
    """Return the body with the victim's module put on wrong."""
    if how == "turned":
        q = body.sensor_to_segment.copy()
        segment = int(np.flatnonzero(body.module_ids == VICTIM)[0])
        q[segment] = quaternion.multiply(_ABOUT_THE_LEG, q[segment])
        return replace(body, sensor_to_segment=q)
    if how == "upside_down":
        return worn_wrong(body, [VICTIM], [])
    other = body.module_ids[body.segment_names.index(_SWAPPED_WITH[how])]
    return worn_wrong(body, [], [VICTIM, int(other)])


@dataclass(frozen=True)
class FaultEffect:
    """What a case did to some segments."""

    worst_deg: float
    """Largest excess from its beginning on."""
    recovery_s: float
    """From its end until the excess stays below a degree; NaN: it lasted to the end, or never did."""


def fault_effect(run: Run, calm: Run, segments: list[int]) -> FaultEffect:
    """Return the outcome over the segments; an undefined segment counts as no error, its status says so."""
    n = min(len(run.times_s), len(calm.times_s))
    at_calm = np.searchsorted(calm.times_s, run.times_s[:n] - 0.005).clip(0, len(calm.times_s) - 1)
    excess = run.error_deg[:n, segments] - calm.error_deg[at_calm][:, segments]
    excess = np.nan_to_num(excess).max(axis=1)
    times, end_s = run.times_s[:n], run.case.ends_s
    after, worst = times >= end_s, float(excess[times >= run.case.begins_s].max())
    if not after.any():
        return FaultEffect(worst, np.nan)
    bad = times[after & (excess > RECOVERED_DEG)]
    is_over = not len(bad) or bad[-1] < times[-1] - 1.0
    recovery_s = (float(bad[-1] - end_s) if len(bad) else 0.0) if is_over else np.nan
    return FaultEffect(worst, recovery_s)


def reported_after_s(run: Run, segments: list[int]) -> float:
    """Return the time from the fault until no segment counts as measured any more, s; NaN: never."""
    is_reported = (run.status[:, segments] > Status.INTERPOLATED).all(axis=1) & (
        run.times_s >= run.case.begins_s
    )
    return float(run.times_s[is_reported][0] - run.case.begins_s) if is_reported.any() else np.nan


WALK_S = 2.75
"""When the walk sets off."""


def doubtful_after_s(run: Run, segments: list[int]) -> float:
    """Return the time from when the walk sets off until all the segments are doubtful, s; NaN: never."""
    is_doubtful = (run.status[:, segments] == Status.DOUBTFUL).all(axis=1)
    return float(run.times_s[is_doubtful][0] - WALK_S) if is_doubtful.any() else np.nan


def is_finite(run: Run) -> bool:
    """Return whether every orientation after the start is a number, and every sigma."""
    settled = run.times_s > 2.0
    return bool(np.isfinite(run.q_wb[settled]).all() and np.isfinite(run.sigma_deg[settled]).all())


def largest_step_deg(run: Run, from_s: float, to_s: float) -> float:
    """Return the largest change of the tilt error from one frame to the next, °: what is seen as a jump."""
    now = (run.times_s >= from_s) & (run.times_s < to_s)
    return float(np.abs(np.diff(run.tilt_deg[now], axis=0)).max())
