"""What OpenSim is told: body, motion, floor forces and wires, as plain numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gateway.analysis.analysing import Analysis
from gateway.analysis.muscle_model import PATELLA, MuscleModel, muscle_model
from gateway.analysis.muscle_paths import MusclePaths
from gateway.analysis.muscles import MuscleResult
from gateway.body.anthropometry import SIDES
from gateway.frames import FloatArray

_KNEE_SAMPLES = np.linspace(-0.15, 2.0, 16)
"""rad of flexion, between which the kneecap's way is a spline."""
_OPTIMISED, _BEFORE_END = 5, 12
"""Frames that are optimised, as OpenSim takes its time for each, and how many come after them: push-off."""
_MARGIN = 25
"""Frames of motion before and after what is asked for: splines know little at their ends."""


def coordinate_names(segment: str) -> list[str]:
    """Of a joint's three rotations about x, y, z, each in the axes that the one before left."""
    return [f"{segment}_{axis}" for axis in ("rx", "ry", "rz")]


def euler_angles(found: Analysis) -> FloatArray:
    """(F, S, 3) rad, continuous, of each segment against its parent: x, then y, then z."""
    frames, segments = found.motion.rotation.shape[:2]
    turned = Rotation.from_quat(found.motion.rotation.reshape(-1, 4), scalar_first=True).as_euler("XYZ")
    angles: FloatArray = np.unwrap(turned.reshape(frames, segments, 3), axis=0)
    return angles


def task_of(found: Analysis, muscles: MuscleResult, begin: int, end: int) -> dict[str, Any]:
    """For the frames from begin to before end."""
    names = found.skeleton.segment_names
    span = slice(max(begin - _MARGIN, 0), end + _MARGIN)
    angles = euler_angles(found)
    columns, values = [], []
    for s, name in enumerate(names):
        columns += coordinate_names(name)
        values.append(angles[span, s])
        if found.skeleton.parents[s] < 0:
            columns += [f"{name}_t{axis}" for axis in "xyz"]
            values.append(found.motion.root[span])
    time_s = found.time_s[span, None]
    return {
        "gravity": [0.0, 0.0, -9.81],
        "bodies": [_body(found, s) for s in range(len(names))],
        "columns": columns,
        "motion": np.hstack([time_s, *values]).tolist(),
        "feet": [names[s] for s in found.floor.segments],
        "floor": np.hstack([time_s, _loads(found)[span]]).tolist(),
        "begin": float(found.time_s[begin]),
        "end": float(found.time_s[end - 1]),
        "optimise_begin": float(found.time_s[end - _OPTIMISED - _BEFORE_END]),
        "optimise_end": float(found.time_s[end - _BEFORE_END - 1]),
        "wires": _wires(found, muscles),
        "asked": _asked(found, muscles),
    }


def _body(found: Analysis, s: int) -> dict[str, Any]:
    skeleton, inertia = found.skeleton, found.inertia
    parent = int(skeleton.parents[s])
    name = skeleton.segment_names[s]
    spread = inertia.inertia[s]
    coordinates = coordinate_names(name)
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
    """Coordinates that muscles are asked for: ours are about the same axes as long as angles are small."""
    axes = "xyz"
    chosen = set()
    for j, k in muscles.torques:
        joint = found.skeleton.joints[j]
        name = found.skeleton.segment_names[joint.distal]
        chosen.add(f"{name}_r{axes[joint.angles[k].axis_index]}")
    return sorted(chosen)


def _wires(found: Analysis, muscles: MuscleResult) -> list[dict[str, Any]]:
    """As mujoco has them on our body, without what they slide over."""
    paths = MusclePaths(found.skeleton, straight())
    model = paths.model
    wires = []
    for name, peak in zip(muscles.names, muscles.largest_force, strict=True):
        tendon = model.tendon(name).id
        start, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        points = [_point(paths, wrap, found) for wrap in range(start, start + count)]
        wires.append({"name": name, "peak": float(peak), "points": points})
    return wires


def straight() -> MuscleModel:
    """The muscles without the bodies that they slide over: the two programs slide differently, and this is
    to compare what comes after."""
    model = muscle_model()
    wires = [
        replace(wire, points=tuple(point for point in wire.points if point.rotation is None))
        for wire in model.wires
    ]
    return replace(model, wires=tuple(wires))


def _point(paths: MusclePaths, wrap: int, found: Analysis) -> dict[str, Any]:
    model, site = paths.model, int(paths.model.wrap_objid[wrap])
    body = model.body(int(model.site_bodyid[site])).name
    if body.endswith(PATELLA):
        return _moving(paths, body, model.site_pos[site], found)
    return {"kind": "point", "body": body, "place": model.site_pos[site].tolist()}


def _moving(paths: MusclePaths, body: str, place: FloatArray, found: Analysis) -> dict[str, Any]:
    """A point of the kneecap on the thigh, over the turn of the knee about z, which is minus its flexion."""
    side = body.removesuffix(PATELLA)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (found.skeleton.n_segments, 1))
    places = []
    for flexion in _KNEE_SAMPLES:
        paths.place(np.zeros(3), still, dict.fromkeys(SIDES, float(flexion)))
        thigh, patella = (paths.model.body(name).id for name in (f"{side}thigh", body))
        data = paths.data
        at = data.xpos[patella] + data.xmat[patella].reshape(3, 3) @ place
        places.append(data.xmat[thigh].reshape(3, 3).T @ (at - data.xpos[thigh]))
    return {
        "kind": "moving", "body": f"{side}thigh", "coordinate": f"{side}shank_rz",
        "angles": (-_KNEE_SAMPLES[::-1]).tolist(), "places": np.array(places)[::-1].T.tolist(),
    }  # fmt: skip
