"""OpenSim's inverse kinematics, in the interpreter that has OpenSim: started by ``opensim_peer``, as a file.

    python -I opensim_child.py CASE.npz ANSWER.npz

Imports nothing of the gateway: the two environments need not agree on anything but numpy.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
import opensim

AXES = np.eye(3)
ROTATIONS = (
    "upd_rotation1", "upd_rotation2", "upd_rotation3",
    "upd_translation1", "upd_translation2", "upd_translation3",
)  # fmt: skip
_INERTIA = opensim.Inertia(0.1, 0.1, 0.1)
"""Of every body: without a mass the model is refused; kinematics do not ask for it."""


def main(case_path: str, answer_path: str) -> None:
    """Read the case, solve every instant, write the poses and the processor time."""
    case = dict(np.load(case_path))
    model = body(case)
    reference = opensim.MarkersReference(marker_table(case), marker_weights(case))
    state = model.initSystem()
    solver = opensim.InverseKinematicsSolver(
        model, reference, opensim.SimTKArrayCoordinateReference(), float("inf")
    )
    solver.setAccuracy(float(case["accuracy"]))
    state.setTime(0.0)
    solver.assemble(state)
    bodies = [model.getBodySet().get(s) for s in range(len(case["parents"]))]
    R, p, seconds = [], [], 0.0
    for instant in case["times"]:
        begun = time.process_time()
        state.setTime(float(instant))
        solver.track(state)
        seconds += time.process_time() - begun
        model.realizePosition(state)
        transforms = [each.getTransformInGround(state) for each in bodies]
        R.append([rotation(each.R()) for each in transforms])
        p.append([[each.p().get(i) for i in range(3)] for each in transforms])
    np.savez(
        answer_path,
        R=np.array(R),
        p=np.array(p),
        ms=1e3 * seconds / len(case["times"]),
        version=opensim.GetVersion(),
    )


def rotation(R: Any) -> list[list[float]]:
    """Of OpenSim's matrices, rows of floats."""
    return [[R.asMat33().get(i, j) for j in range(3)] for i in range(3)]


def body(case: dict[str, Any]) -> Any:
    """The model: a free root, and joints that turn about the axes they are free about."""
    model = opensim.Model()
    model.setUseVisualizer(False)
    for s, parent in enumerate(case["parents"].tolist()):
        each = opensim.Body(f"segment_{s}", 1.0, opensim.Vec3(0.0), _INERTIA)
        model.addBody(each)
        if parent < 0:
            model.addJoint(opensim.FreeJoint("root", model.getGround(), each))
            continue
        model.addJoint(
            opensim.CustomJoint(
                f"joint_{s}",
                model.getBodySet().get(parent), vector(case["offsets"][s]), opensim.Vec3(0.0),
                each, opensim.Vec3(0.0), opensim.Vec3(0.0),
                turning(s, case["axes"][s], case["free"][s]),
            )
        )  # fmt: skip
    for m, segment in enumerate(case["segments"].tolist()):
        place = vector(case["positions"][m])
        model.addMarker(opensim.Marker(f"marker_{m}", model.getBodySet().get(segment), place))
    model.finalizeConnections()
    return model


def turning(segment: int, axes: np.ndarray[Any, Any], free: np.ndarray[Any, Any]) -> Any:
    """Three turns about body-fixed axes, one after another; those that are not free stay at nought."""
    transform = opensim.SpatialTransform()
    for k, name in enumerate(ROTATIONS):
        axis = getattr(transform, name)()
        if k < len(axes) and free[k]:
            names = opensim.ArrayStr()
            names.append(f"angle_{segment}_{k}")
            axis.setCoordinateNames(names)
            axis.set_function(opensim.LinearFunction(1.0, 0.0))
        else:
            axis.set_function(opensim.Constant(0.0))
        axis.set_axis(vector(AXES[axes[k] if k < len(axes) else k - len(axes)]))
    return transform


def marker_table(case: dict[str, Any]) -> Any:
    """What was seen; NaN where a marker was not, which OpenSim leaves out."""
    table = opensim.TimeSeriesTableVec3()
    table.setColumnLabels([f"marker_{m}" for m in range(len(case["segments"]))])
    for instant, seen in zip(case["times"], case["observed"], strict=True):
        table.appendRow(float(instant), opensim.RowVectorVec3([vector(each) for each in seen]))
    return table


def marker_weights(case: dict[str, Any]) -> Any:
    """By marker, relative."""
    weights = opensim.SetMarkerWeights()
    for m, weight in enumerate(case["weights"].tolist()):
        weights.cloneAndAppend(opensim.MarkerWeight(f"marker_{m}", weight))
    return weights


def vector(values: Any) -> Any:
    """Three numbers as OpenSim takes them."""
    return opensim.Vec3(*(float(each) for each in values))


main(*sys.argv[1:])
