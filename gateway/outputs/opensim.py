"""Poses as coordinates of an OpenSim model: JSON, each pose a datagram."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import orjson
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import parse

from devices.deferred import Rotation
from gateway.body.joint_angles import JointAngles
from gateway.body.skeleton import Skeleton
from gateway.contract.opensim_names import COORDINATES
from gateway.errors import OutputError
from gateway.frames import FloatArray, SkeletonFrame
from gateway.outputs.settings import OpenSimSettings

_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""World (east, north, up) to OpenSim's ground (x forward, y up, z to the right)."""


class OpenSimEncoder:
    """Makes ``{"t_ns", "seq", "coordinates"}`` of a frame: rad and m, only what is known.

    Angles without a counterpart in the model of Rajagopal et al. keep our names: elbows and ankles are among
    them, which turn about other axes there.
    """

    def __init__(self, settings: OpenSimSettings, skeleton: Skeleton) -> None:
        """Raises ``OutputError`` for a model that cannot be read, or knows none of the coordinates."""
        self._angles = JointAngles(skeleton)
        self._rows: list[tuple[str, float, int, int]] = []
        for j, joint in enumerate(skeleton.joints):
            for a, angle in enumerate(joint.angles):
                own = f"{joint.name}_{angle.name}"
                name, sign = COORDINATES.get(own, (own, 1.0))
                self._rows.append((name, sign, j, a))
        root = skeleton.segment_names[int(np.flatnonzero(skeleton.parents < 0)[0])]
        self._turns = tuple(f"{root}_{turn}" for turn in ("tilt", "list", "rotation"))
        self._places = tuple(f"{root}_t{axis}" for axis in "xyz")
        self._last = np.zeros(3)
        self._kept: frozenset[str] | None = None
        if settings.model is not None:
            self._keep(_coordinates(settings.model), settings.model)

    def encode(self, frame: SkeletonFrame) -> list[bytes]:
        """Return the datagram of a frame; frames come in order, since angles are continuous."""
        angles = self._angles.update(np.ascontiguousarray(frame.q_wb)).angles
        found = {name: sign * float(angles[j, a]) for name, sign, j, a in self._rows}
        found.update(zip(self._turns, self._root_turns(frame.q_wb[frame.root]), strict=True))
        found.update(zip(self._places, (_UP @ frame.p_w[frame.root]).tolist(), strict=True))
        kept = found if self._kept is None else self._kept
        known = {
            name: round(value, 6) for name, value in found.items() if math.isfinite(value) and name in kept
        }
        return [orjson.dumps({"t_ns": frame.time_ns, "seq": frame.sequence, "coordinates": known})]

    def _keep(self, model: frozenset[str], path: Path) -> None:
        ours = {name for name, *_ in self._rows} | {*self._turns, *self._places}
        self._kept = model & ours
        if not self._kept:
            raise OutputError(
                f"outputs.opensim: {path}: none of its coordinates ({', '.join(sorted(model)[:5])} …) is one "
                f"of this body ({', '.join(sorted(ours)[:5])} …): rename them, or take another model"
            )

    def _root_turns(self, q_wb: FloatArray) -> list[float]:
        """Return tilt, list and rotation, rad, each next to what it was before."""
        if np.isnan(q_wb[0]):
            return [math.nan] * 3
        turned = Rotation.from_matrix(_UP) * Rotation.from_quat(np.roll(q_wb, -1))
        angles = np.asarray(turned.as_euler("ZXY"))
        self._last = angles + 2 * np.pi * np.round((self._last - angles) / (2 * np.pi))
        turns: list[float] = self._last.tolist()
        return turns


def _coordinates(path: Path) -> frozenset[str]:
    """Return the names of an ``.osim``'s coordinates. Raises ``OutputError``."""
    try:
        tree = parse(path)
    except (OSError, ValueError, SyntaxError, DefusedXmlException) as error:
        raise OutputError(f"outputs.opensim: {path} cannot be read as an .osim: {error}") from error
    names = (element.get("name") for element in tree.iter("Coordinate"))
    return frozenset(name for name in names if name)
