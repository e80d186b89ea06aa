"""OpenSim: ``.sto`` with orientations for OpenSense, ``.mot`` with joint angles. Text.

Orientations are segment to world in columns ``<segment>_imu``; segments have axes x anterior, y superior,
z to the right, as OpenSim's bodies have, so with world axes y-up OpenSense needs no further rotation.

Angles are a take's pose as coordinates of OpenSim models: those of the body's own model (``opensim_model``),
and those that only the model of Rajagopal et al. has, whose arms, elbows and ankles turn about other axes
than ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from devices.deferred import Rotation
from gateway.body.joints import Decomposition, Joint
from gateway.body.skeleton import Skeleton
from gateway.contract.opensim_names import (
    ANKLE_AXIS,
    COORDINATES,
    ELBOW_AXIS,
    ELBOW_IN_HUMERUS,
    HIP_IN_PELVIS,
    LEG_M,
    PRONATION_AXIS,
    SIDES,
    SUBTALAR_AXIS,
    WRIST_IN_ULNA,
)
from gateway.frames import FloatArray
from gateway.recording.exporters.take import Take, rotation

Columns = list[tuple[str, FloatArray]]
"""Name and values (F,) of each."""
_STEPS = 20
"""Of Gauss and Newton, for two or three angles."""
_DAMPING = 1e-6
_TWIST_STIFFNESS = 0.02
"""Of an upper arm's turn about its length: decides where a straight elbow shows none."""
_ROOT_TURNS = ("tilt", "list", "rotation")


class Turns(NamedTuple):
    """How a segment turns against its parent in the body's own model: about three axes, one after another."""

    segment: int
    coordinates: tuple[str, str, str]
    axes: FloatArray  # (3, 3) a unit axis a row, along one of x, y, z
    limits: FloatArray  # (3, 2) rad

    @property
    def sequence(self) -> str:
        """Of rotations about moving axes."""
        return "".join("XYZ"[int(np.argmax(np.abs(axis)))] for axis in self.axes)


def model_turns(skeleton: Skeleton) -> list[Turns]:
    """Return the turns of every segment, the root in the ground first.

    A coordinate that Rajagopal's model has too is called as there; a joint without Cardan angles turns
    about z, x, y.
    """
    described = {joint.distal: joint for joint in skeleton.joints if _is_cardan(joint, skeleton)}
    turns = []
    for s, name in enumerate(skeleton.segment_names):
        joint = described.get(s)
        if joint is not None:
            turns.append(_described(s, joint))
            continue
        named = _ROOT_TURNS if skeleton.parents[s] < 0 else ("about_z", "about_x", "about_y")
        first, second, third = (f"{name}_{each}" for each in named)
        free = np.tile([-np.pi, np.pi], (3, 1))
        turns.append(Turns(s, (first, second, third), np.eye(3)[[2, 0, 1]], free))
    return turns


def _is_cardan(joint: Joint, skeleton: Skeleton) -> bool:
    return (
        joint.distal >= 0
        and joint.proximal == skeleton.parents[joint.distal] >= 0
        and joint.decomposition is Decomposition.CARDAN
        and len(joint.angles) == len(set(joint.sequence)) == 3
    )


def _described(segment: int, joint: Joint) -> Turns:
    names, axes, limits = [], [], []
    for angle in joint.angles:
        own = f"{joint.name}_{angle.name}"
        name, factor = COORDINATES.get(own, (own, 1.0))
        names.append(name)
        axes.append(factor * angle.sign * np.eye(3)[angle.axis_index])
        limits.append(sorted(factor * each for each in np.clip(angle.limits, -np.pi, np.pi)))
    first, second, third = names
    return Turns(segment, (first, second, third), np.array(axes), np.array(limits))


def pelvis_origin(skeleton: Skeleton) -> FloatArray:
    """Return the place (3,) of the pelvis' origin of Rajagopal's model with legs as long, m from the root's
    joint.

    Zero for a body without legs.
    """
    names = skeleton.segment_names
    thighs, shanks = ([f"{side}_{part}" for side, _, _ in SIDES] for part in ("thigh", "shank"))
    if not {*thighs, *shanks} <= {*names}:
        return np.zeros(3)
    hips = skeleton.offsets[[names.index(each) for each in thighs]]
    ends = skeleton.tips[[names.index(each) for each in (*thighs, *shanks)]]
    # Half of the sum, as both legs are in it.
    size = 0.5 * float(np.linalg.norm(ends, axis=1).sum()) / LEG_M
    origin: FloatArray = hips.mean(axis=0) - size * np.array([HIP_IN_PELVIS[0], HIP_IN_PELVIS[1], 0.0])
    return origin


def model_columns(take: Take, units_per_m: float) -> Columns:
    """Return all coordinates of the body's own model: angles, degrees, and the root's place."""
    skeleton = take.skeleton
    columns: Columns = []
    for turns in model_turns(skeleton):
        s, parent = turns.segment, int(skeleton.parents[turns.segment])
        turned = rotation(take.q_wb[:, s])
        if parent >= 0:
            turned = rotation(take.q_wb[:, parent]).inv() * turned
        signs = turns.axes.sum(axis=1)
        found: FloatArray = turned.as_euler(turns.sequence)  # type: ignore[call-overload]  # of three letters
        angles = np.degrees(np.unwrap(found, axis=0)) * signs
        columns += zip(turns.coordinates, angles.T, strict=True)
        if parent < 0:
            origin = take.p_w[:, s] + turned.apply(pelvis_origin(skeleton))
            name = skeleton.segment_names[s]
            columns += [(f"{name}_t{axis}", origin[:, i] * units_per_m) for i, axis in enumerate("xyz")]
    return columns


def rajagopal_columns(take: Take) -> Columns:
    """Return arms, elbows and ankles, degrees, where Rajagopal's model comes nearest to the pose.

    Its elbow and knee have no carrying angle and no adduction: upper arms turn about their length so that
    forearms lie right, and feet lie as they do whatever the shank of the model does.
    """
    names = take.skeleton.segment_names
    columns: Columns = []
    for side, letter, out in SIDES:
        mirror = np.array([1.0, 1.0, out])
        if {"thorax", f"{side}_upper_arm", f"{side}_forearm"} <= {*names}:
            elbow, wrist = (_unit(np.array(end) * mirror) for end in (ELBOW_IN_HUMERUS, WRIST_IN_ULNA))
            turns = elbow, *(_unit(np.array(axis) * (out, out, 1.0)) for axis in (ELBOW_AXIS, PRONATION_AXIS))
            # The model's bones are not straight along y as ours are, so each is turned into its own axes
            # first.
            upper = _of(take, f"{side}_upper_arm") * _turn_down(elbow)
            lower = _of(take, f"{side}_forearm") * _turn_down(wrist)
            twist, flexion, pronation = _turned_about(turns, upper.inv() * lower, _TWIST_STIFFNESS).T
            # The twist goes into the humerus: the model's elbow cannot take it.
            humerus = upper * Rotation.from_rotvec(twist[:, None] * elbow)
            arm = (_of(take, "thorax").inv() * humerus).as_euler("ZXY") * (1.0, out, out)
            named = ("arm_flex", "arm_add", "arm_rot", "elbow_flex", "pro_sup")
            columns += _degrees(letter, named, np.column_stack([arm, flexion, pronation]))
        if {f"{side}_thigh", f"{side}_shank", f"{side}_foot"} <= {*names}:
            turns = tuple(_unit(np.array(axis) * (out, out, 1.0)) for axis in (ANKLE_AXIS, SUBTALAR_AXIS))
            # The model's knee only bends about z; what else the knee does would tilt its foot, and goes to
            # the ankle.
            thigh = _of(take, f"{side}_thigh")
            bent = (thigh.inv() * _of(take, f"{side}_shank")).as_euler("ZXY")[:, 0]
            shank = thigh * Rotation.from_rotvec(bent[:, None] * [0.0, 0.0, 1.0])
            found = _turned_about(turns, shank.inv() * _of(take, f"{side}_foot"), 0.0)
            columns += _degrees(letter, ("ankle_angle", "subtalar_angle"), found)
    return columns


def _degrees(letter: str, names: Sequence[str], angles: FloatArray) -> Columns:
    smooth = np.degrees(np.unwrap(angles, axis=0))
    return [(f"{name}_{letter}", series) for name, series in zip(names, smooth.T, strict=True)]


def _of(take: Take, segment: str) -> Rotation:
    return rotation(take.q_wb[:, take.skeleton.index(segment)])


def _unit(vector: FloatArray) -> FloatArray:
    unit: FloatArray = vector / np.linalg.norm(vector)
    return unit


def _turn_down(along: FloatArray) -> Rotation:
    """Return the smallest rotation of a direction (3,) to -y.

    In our bodies y leads along an arm bone from joint to joint; in Rajagopal's model it deviates a little.
    """
    across = np.cross(along, [0.0, -1.0, 0.0])
    sine = float(np.linalg.norm(across))
    return Rotation.from_rotvec(np.arctan2(sine, -along[1]) * across / sine)


def _turned_about(axes: Sequence[FloatArray], turned: Rotation, stiffness: float) -> FloatArray:
    """Return angles (F, n), rad, about moving axes in turn, whose product comes nearest to rotations (F,).

    stiffness: draws the first of them to zero, 1/rad² against the squared distance from the rotation.
    """
    n = len(axes)
    angles = np.zeros((len(turned), n))
    # The flexion of a ZXY decomposition is near the solution, so that few steps of Gauss-Newton suffice.
    angles[:, -2] = turned.as_euler("ZXY")[:, 0]
    drawn = np.diag([stiffness] + [_DAMPING] * (n - 1))
    for _ in range(_STEPS):
        turns = [Rotation.from_rotvec(angles[:, k, None] * axes[k]) for k in range(n)]
        rows: list[FloatArray] = []
        after = Rotation.identity(len(turned))
        for axis, turn in zip(reversed(axes), reversed(turns), strict=True):
            rows.insert(0, after.inv().apply(axis))
            after = turn * after
        along = np.stack(rows, axis=1)
        pull = np.einsum("fki,fi->fk", along, (after.inv() * turned).as_rotvec())
        pull[:, 0] -= stiffness * angles[:, 0]
        angles += np.linalg.solve(along @ np.swapaxes(along, 1, 2) + drawn, pull[..., None])[..., 0]
    return angles


_VERSION = "4.5"


def write_sto(take: Take, path: Path, _units_per_m: float) -> None:
    """Write orientations of a take for OpenSense. Raises ``OSError``."""
    head = [
        f"DataRate={take.rate_hz:.9f}".rstrip("0").rstrip("."),
        "DataType=Quaternion",
        "version=3",
        f"OpenSimVersion={_VERSION}",
        "endheader",
        "\t".join(["time", *(f"{name}_imu" for name in take.skeleton.segment_names)]),
    ]
    with path.open("w", encoding="utf-8") as file:
        file.write("\n".join(head) + "\n")
        for time_s, pose in zip(take.time_s, take.q_wb, strict=True):
            # OpenSense separates the parts of a quaternion by commas, columns by tabulators.
            cells = (",".join(f"{component:.9f}" for component in q) for q in pose)
            file.write("\t".join([f"{time_s:.6f}", *cells]) + "\n")


def write_mot(take: Take, path: Path, units_per_m: float) -> None:
    """Write joint angles, degrees, and the root's place for OpenSim. Raises ``OSError``.

    Columns are the coordinates of the body's own model, those that only Rajagopal's model has, and angles
    that are in neither. OpenSim ignores columns that a model does not know.
    """
    columns, values = ["time"], [take.time_s]
    known = [*model_columns(take, units_per_m), *rajagopal_columns(take)]
    for name, series in (*known, *_other_angles(take, {name for name, _ in known})):
        columns.append(name)
        values.append(series)
    table = np.column_stack(values)
    head = [
        path.stem,
        "version=1",
        f"nRows={table.shape[0]}",
        f"nColumns={table.shape[1]}",
        "inDegrees=yes",
        "endheader",
        "\t".join(columns),
    ]
    with path.open("w", encoding="utf-8") as file:
        file.write("\n".join(head) + "\n")
        np.savetxt(file, table, fmt="%.8f", delimiter="\t")


def _other_angles(take: Take, known: set[str]) -> Columns:
    """Return the take's own angles, degrees, that have no name in either model."""
    columns: Columns = []
    for joint, angle, name in take.angle_names:
        series = take.joint_angles[:, joint, angle]
        if name not in known and name not in COORDINATES and not np.isnan(series).any():
            columns.append((name, np.degrees(series)))
    return columns
