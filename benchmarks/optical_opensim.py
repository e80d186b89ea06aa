"""OpenSim's inverse kinematics beside the default method: the same fitted body, markers and frames."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from benchmarks import opensim_peer
from benchmarks.figures import table
from devices.marker_files import MarkerTrial
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.optical.landmarks import to_world

JOINTS = ("hip", "knee", "ankle", "shoulder", "elbow")


class Ours(Protocol):
    """What the default method found in the held-out frames."""

    @property
    def q_wb(self) -> FloatArray: ...
    @property
    def residuals(self) -> FloatArray: ...
    @property
    def ms(self) -> float: ...


class OpenSimBeside:
    """Rows of one table, a trial each; or why there are none."""

    def __init__(self) -> None:
        self._rows: list[list[str]] = []
        self._why = ""

    def add(self, name: str, skeleton: Skeleton, markers: BodyMarkers, held: MarkerTrial, ours: Ours) -> None:
        """Solve the trial with OpenSim too, where it is installed."""
        observed = to_world(held.columns(markers.labels), markers.vertical)
        try:
            theirs = opensim_peer.solve(skeleton, markers, observed, held.rate_hz)
        except opensim_peer.OpenSimMissingError as missing:
            self._why = str(missing)
            return
        q_wb = np.array([[quaternion.from_matrix(each) for each in pose] for pose in theirs.R])
        rmse = float(np.sqrt(np.nanmean(ours.residuals**2)))
        apart = _apart(skeleton, ours.q_wb, q_wb)
        self._rows.append(
            [name, f"{1e3 * rmse:.2f}", f"{1e3 * theirs.rmse:.2f}", f"{ours.ms:.2f}", f"{theirs.ms:.2f}"]
            + [f"{apart[joint]:.1f}" for joint in JOINTS]
        )

    def text(self) -> str:
        """The table with its title."""
        title = "## OpenSim's inverse kinematics on the same body and held-out frames\n\n"
        if not self._rows:
            return f"{title}Skipped: {self._why or 'no trial is here'}."
        heads = ["trial", "markers mm, ours", "OpenSim", "ms a frame, ours", "OpenSim"]
        note = (
            "\n\nMarkers: RMSE of all that were seen. Joints: RMSE of the angle between the two rotations "
            "against the parent segment, both sides. OpenSim turns knees and elbows about one axis only; the "
            "default method lets them turn otherwise too, where the markers say so."
        )
        return title + table([*heads, *(f"{joint} °" for joint in JOINTS)], self._rows) + note


def _apart(skeleton: Skeleton, ours: FloatArray, theirs: FloatArray) -> dict[str, float]:
    """Degrees, by kind of joint."""
    squares: dict[str, list[float]] = {joint: [] for joint in JOINTS}
    for joint in skeleton.joints:
        kind = next((each for each in JOINTS if joint.name.endswith(f"_{each}")), None)
        if kind is None:
            continue
        for one, other in zip(ours, theirs, strict=True):
            pair = [
                quaternion.multiply(quaternion.conjugate(q[joint.proximal]), q[joint.distal])
                for q in (one, other)
            ]
            if np.isfinite(pair).all():
                squares[kind].append(quaternion.angle_between(*pair) ** 2)
    return {kind: float(np.degrees(np.sqrt(np.mean(each)))) for kind, each in squares.items()}
