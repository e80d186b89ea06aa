"""What OpenSim is told: body, motion, floor forces and wires, as plain numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gateway.analysis.analysing import Analysis
from gateway.analysis.muscle_model import PATELLA, WRAP_SPHERE, muscle_model
from gateway.analysis.muscle_paths import MusclePaths
from gateway.analysis.muscles import MuscleResult
from gateway.body.anthropometry import SIDES
from gateway.body.joints import Decomposition
from gateway.frames import FloatArray

_KNEE_SAMPLES = np.linspace(-0.15, 2.0, 16)
"""rad of flexion, between which the kneecap's way is a spline."""
EVERY = 2
"""OpenSim takes its time for each frame: of so many one is optimised."""
_ARMS_AT = 5
"""Of so many optimised frames moment arms are told of one."""
_MARGIN = 25
"""Frames of motion before and after what is asked for: splines know little at their ends."""


def order_of(found: Analysis, s: int) -> str:
    """Axes (``zxy``) that a segment turns about one after the other against its parent: those of its joint's
    angles, so that OpenSim's coordinates are ours; where those are not three, x, y, z."""
    parent = int(found.skeleton.parents[s])
    for joint in found.skeleton.joints:
        if joint.distal == s and joint.proximal == parent:
            order = "".join("xyz"[angle.axis_index] for angle in joint.angles)
            if joint.decomposition is Decomposition.CARDAN and sorted(order) == ["x", "y", "z"]:
                return order
    return "xyz"


def coordinate_names(found: Analysis, s: int) -> list[str]:
    """Of a segment's three rotations against its parent, each in the axes that the one before left."""
    return [f"{found.skeleton.segment_names[s]}_r{axis}" for axis in order_of(found, s)]


def euler_angles(found: Analysis, s: int) -> FloatArray:
    """(F, 3) rad, continuous, of a segment against its parent."""
    turned = Rotation.from_quat(found.motion.rotation[:, s], scalar_first=True)
    order: Any = order_of(found, s).upper()  # scipy's types want it literally
    angles: FloatArray = np.unwrap(turned.as_euler(order), axis=0)
    return angles


def gimbal_axes(found: Analysis, s: int) -> FloatArray:
    """(F, 3, 3) world axes of a segment's three rotations, by row."""
    turned, order = found.dynamics.rotation_wb, order_of(found, s)
    parent, own = turned[:, found.skeleton.parents[s]], turned[:, s]
    first, second, third = ("xyz".index(axis) for axis in order)
    begun = Rotation.from_euler(order[0], euler_angles(found, s)[:, :1]).as_matrix()
    axes: FloatArray = np.stack([parent[..., first], (parent @ begun)[..., second], own[..., third]], axis=1)
    return axes


def arms_at(begin: int, end: int) -> list[int]:
    """Frames whose moment arms are compared."""
    return list(range(begin, end, EVERY * _ARMS_AT))


def task_of(found: Analysis, muscles: MuscleResult, begin: int, end: int) -> dict[str, Any]:
    """For the frames from begin to before end."""
    names = found.skeleton.segment_names
    span = slice(max(begin - _MARGIN, 0), end + _MARGIN)
    columns, values = [], []
    for s, name in enumerate(names):
        columns += coordinate_names(found, s)
        values.append(euler_angles(found, s)[span])
        if found.skeleton.parents[s] < 0:
            columns += [f"{name}_t{axis}" for axis in "xyz"]
            values.append(found.motion.root[span])
    time_s = found.time_s[span, None]
    motion = np.hstack([time_s, *values])
    return {
        "gravity": [0.0, 0.0, -9.81],
        "bodies": [_body(found, s) for s in range(len(names))],
        "columns": columns,
        "motion": motion.tolist(),
        "feet": [names[s] for s in found.floor.segments],
        "floor": np.hstack([time_s, _loads(found)[span]]).tolist(),
        "begin": float(found.time_s[begin]),
        "end": float(found.time_s[end - 1]),
        "every": EVERY,
        "arms_rows": [motion[f - span.start, 1:].tolist() for f in arms_at(begin, end)],
        "wires": _wires(found, muscles),
        "kneecaps": _kneecaps(found),
        "asked": _asked(found, muscles),
    }


def _body(found: Analysis, s: int) -> dict[str, Any]:
    skeleton, inertia = found.skeleton, found.inertia
    parent = int(skeleton.parents[s])
    name = skeleton.segment_names[s]
    spread = inertia.inertia[s]
    coordinates = coordinate_names(found, s)
    return {
        "name": name,
        "parent": None if parent < 0 else skeleton.segment_names[parent],
        "offset": skeleton.offsets[s].tolist(),
        "mass": float(inertia.mass[s]),
        "centre": inertia.centre[s].tolist(),
        "inertia": spread[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist(),
        "coordinates": coordinates if parent >= 0 else coordinates + [f"{name}_t{axis}" for axis in "xyz"],
    }


def _loads(found: Analysis) -> FloatArray:
    """(F, 9 C): force, point (the origin) and moment of each foot."""
    floor = found.floor
    stacked = np.stack([floor.force, np.zeros_like(floor.force), floor.moment], axis=2)
    flat: FloatArray = stacked.reshape(len(stacked), -1)
    return flat


def _asked(found: Analysis, muscles: MuscleResult) -> list[str]:
    """Coordinates that muscles are asked for."""
    return sorted({coordinate(found, j, k) for j, k in muscles.torques})


def coordinate(found: Analysis, joint: int, angle: int) -> str:
    """OpenSim's name of one of our angles."""
    found_joint = found.skeleton.joints[joint]
    return (
        f"{found.skeleton.segment_names[found_joint.distal]}_r{'xyz'[found_joint.angles[angle].axis_index]}"
    )


def _wires(found: Analysis, muscles: MuscleResult) -> list[dict[str, Any]]:
    """As mujoco has them on our body, with what they slide over."""
    paths = MusclePaths(found.skeleton, muscle_model())
    model = paths.model
    wires = []
    for name, peak in zip(muscles.names, muscles.largest_force, strict=True):
        tendon = model.tendon(name).id
        start, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        points = [_point(paths, wrap) for wrap in range(start, start + count)]
        wires.append({"name": name, "peak": float(peak), "points": points})
    return wires


def _point(paths: MusclePaths, wrap: int) -> dict[str, Any]:
    model, thing = paths.model, int(paths.model.wrap_objid[wrap])
    if int(model.wrap_type[wrap]) in (WRAP_SPHERE, WRAP_SPHERE + 1):
        return _wrapped(paths, wrap)
    body = model.body(int(model.site_bodyid[thing])).name
    return {"kind": "point", "body": body, "place": model.site_pos[thing].tolist()}


def _wrapped(paths: MusclePaths, wrap: int) -> dict[str, Any]:
    """A cylinder or ball. On which side of it a wire goes is left to whichever way is shorter: mujoco tells a
    side by a point, OpenSim by a quarter of the space, and the one is not the other."""
    model, geom = paths.model, int(paths.model.wrap_objid[wrap])
    turned = Rotation.from_quat(model.geom_quat[geom], scalar_first=True)
    return {
        "kind": "wrap", "body": model.body(int(model.geom_bodyid[geom])).name,
        "place": model.geom_pos[geom].tolist(), "turn": turned.as_euler("XYZ").tolist(),
        "radius": float(model.geom_size[geom, 0]), "is_sphere": int(model.wrap_type[wrap]) == WRAP_SPHERE,
    }  # fmt: skip


def _standing(paths: MusclePaths) -> FloatArray:
    """(S, 4) of the neutral posture."""
    return np.tile([1.0, 0.0, 0.0, 0.0], (paths.skeleton.n_segments, 1))


def _kneecaps(found: Analysis) -> list[dict[str, Any]]:
    """Their ways on the thighs over the turn of the knees about z, which is minus their flexion."""
    paths = MusclePaths(found.skeleton, muscle_model())
    return [_kneecap(paths, side) for side in SIDES]


def _kneecap(paths: MusclePaths, side: str) -> dict[str, Any]:
    data, (thigh, patella) = paths.data, (paths.model.body(f"{side}{part}").id for part in ("thigh", PATELLA))
    rows = []
    for flexion in _KNEE_SAMPLES[::-1]:
        paths.place(np.zeros(3), _standing(paths), dict.fromkeys(SIDES, float(flexion)))
        under = data.xmat[thigh].reshape(3, 3).T
        x, y, _ = under @ (data.xpos[patella] - data.xpos[thigh])
        turned = under @ data.xmat[patella].reshape(3, 3)
        rows.append((np.arctan2(turned[1, 0], turned[0, 0]), x, y))
    ways = dict(zip(("rz", "tx", "ty"), np.array(rows).T.tolist(), strict=True))
    return {
        "name": f"{side}{PATELLA}", "thigh": f"{side}thigh", "coordinate": f"{side}shank_rz",
        "angles": (-_KNEE_SAMPLES[::-1]).tolist(), "ways": ways,
    }  # fmt: skip
