"""The wires of muscles on a person's body: where they run, and what they turn."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from gateway.analysis.muscle_model import PATELLA, TRUNK, MuscleModel, WirePoint
from gateway.body.anthropometry import SIDES
from gateway.body.inertia import neutral_positions
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray

_HALF_LENGTH_M = 0.2
"""Drawn, of cylinders that wires slide over: mujoco takes them as endless."""
_JOINTS = ("x", "y", "turn")


class MusclePaths:
    """All wires on one body, instant by instant. Its body must begin with its root."""

    def __init__(self, skeleton: Skeleton, muscles: MuscleModel) -> None:
        """Build the paths. Raises ``GatewayError`` for a body without pelvis, thighs, shanks and feet."""
        import mujoco  # noqa: PLC0415 - an extra

        self._mujoco = mujoco
        self._scaling = _Scaling(skeleton, muscles)
        known = {*skeleton.segment_names, *(side + PATELLA for side in SIDES)}
        self.wires = tuple(
            wire for wire in muscles.wires if all(point.segment in known for point in wire.points)
        )
        self._muscles, self.skeleton = muscles, skeleton
        self.model = mujoco.MjModel.from_xml_string(self._mjcf())
        self.data = mujoco.MjData(self.model)
        names = skeleton.segment_names
        self._positions = [int(self.model.joint(name).qposadr[0]) for name in names]
        self._rates = [int(self.model.joint(name).dofadr[0]) for name in names]
        self._tendons = [self.model.tendon(wire.name).id for wire in self.wires]

    def place(self, root: FloatArray, rotation: FloatArray, flexion: dict[str, float]) -> None:
        """Put the body into a posture. root: (3,) m. rotation: (S, 4) segment to parent, root to world.
        flexion: of the knees by side (``left_``), rad."""
        data = self.data
        for s, at in enumerate(self._positions):
            begin = at
            if self.skeleton.parents[s] < 0:
                data.qpos[at : at + 3], begin = root, at + 3
            data.qpos[begin : begin + 4] = rotation[s]
        for side, angle in flexion.items():
            shifts = [polyval(angle, row) for row in self._muscles.patella[side]]
            for joint, shift, size in zip(_JOINTS, shifts, self._patella_sizes(), strict=True):
                data.qpos[self.model.joint(f"{side}{PATELLA}_{joint}").qposadr[0]] = shift * size
        self._mujoco.mj_kinematics(self.model, data)
        self._mujoco.mj_comPos(self.model, data)
        self._mujoco.mj_tendon(self.model, data)

    def moments(self, segment: int) -> FloatArray:
        """Return (W, 3) N m in the segment's axes at its proximal joint, for one newton in each wire."""
        begin = self._rates[segment] + (3 if self.skeleton.parents[segment] < 0 else 0)
        return -self._jacobian()[:, begin : begin + 3]

    def patella_moments(self, side: str, flexion: float) -> FloatArray:
        """Return (W,) N m that one newton in each wire gives to the knee's flexion by way of the patella."""
        jacobian = self._jacobian()
        total = np.zeros(len(self.wires))
        for joint, row, size in zip(_JOINTS, self._muscles.patella[side], self._patella_sizes(), strict=True):
            column = int(self.model.joint(f"{side}{PATELLA}_{joint}").dofadr[0])
            total -= jacobian[:, column] * size * polyval(flexion, polyder(row))
        return total

    def lengths(self) -> FloatArray:
        """Return (W,) m."""
        lengths: FloatArray = self.data.ten_length[self._tendons].copy()
        return lengths

    def polylines(self) -> list[FloatArray]:
        """Return for each wire its points (n, 3) m in the world, bends over bodies included."""
        data = self.data
        places = data.wrap_xpos.reshape(-1, 3)
        return [
            places[data.ten_wrapadr[t] : data.ten_wrapadr[t] + data.ten_wrapnum[t]].copy()
            for t in self._tendons
        ]

    def _jacobian(self) -> FloatArray:
        """Return (W, nv) change of length by rates."""
        model = self.model
        dense = np.zeros((model.ntendon, model.nv))
        self._mujoco.mju_sparse2dense(
            dense, self.data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
        )
        return dense[self._tendons]

    def _patella_sizes(self) -> tuple[float, float, float]:
        return self._scaling.size, self._scaling.size, 1.0

    def _mjcf(self) -> str:
        model = Element("mujoco", model=f"{self.skeleton.name} muscles")
        SubElement(model, "compiler", angle="radian")
        SubElement(SubElement(model, "option"), "flag", contact="disable", constraint="disable")
        bodies = _bodies(SubElement(model, "worldbody"), self.skeleton)
        for side in SIDES:
            bodies[side + PATELLA] = _patella(bodies[f"{side}thigh"], side, self._scaling)
        tendons = SubElement(model, "tendon")
        for wire in self.wires:
            path = SubElement(tendons, "spatial", name=wire.name)
            for number, point in enumerate(wire.points):
                self._add(point, f"{wire.name}_{number}", bodies, path)
        return tostring(model, encoding="unicode")

    def _add(self, point: WirePoint, name: str, bodies: dict[str, Element], path: Element) -> None:
        """Add a point of a wire, as a site, or a geom and the site on its side."""
        place = self._scaling.placed(point.segment, point.position, name)
        if point.rotation is None:
            SubElement(bodies[point.segment], "site", name=name, pos=_text(place))
            SubElement(path, "site", site=name)
            return
        radius = point.radius_m * self._scaling.size
        SubElement(
            bodies[point.segment], "geom", name=name, pos=_text(place),
            type="sphere" if point.is_sphere else "cylinder", contype="0", conaffinity="0", mass="0",
            size=repr(radius) if point.is_sphere else f"{radius!r} {_HALF_LENGTH_M}",
            xyaxes=_text(point.rotation.T[:2].ravel()),
        )  # fmt: skip
        wrap = SubElement(path, "geom", geom=name)
        if point.side is not None:
            beside = self._scaling.placed(point.side_segment, point.side, name)
            SubElement(bodies[point.side_segment], "site", name=f"{name}_side", pos=_text(beside))
            wrap.set("sidesite", f"{name}_side")


class _Scaling:
    """From the published model's size to a person's.

    Thighs and shanks: along the bone by its length, with the bone's own slant; all else by the legs' length.
    Points of the pelvis keep their place from the hip of their side, those of the trunk from the middle.
    """

    def __init__(self, skeleton: Skeleton, muscles: MuscleModel) -> None:
        names = skeleton.segment_names
        if absent := absent_segments(skeleton):
            raise GatewayError(f"body '{skeleton.name}' carries no muscles: it has no {', '.join(absent)}")
        self._tips = {name: skeleton.tips[names.index(name)] for name in muscles.tips}
        self._model_tips = muscles.tips
        self._patella_at = muscles.patella_at
        ratios = [
            np.linalg.norm(self._tips[name]) / np.linalg.norm(tip) for name, tip in muscles.tips.items()
        ]
        self.size = float(np.mean(ratios))
        placed = neutral_positions(skeleton)
        pelvis = placed[names.index("pelvis")]
        self._hips = {side: placed[names.index(f"{side}thigh")] - pelvis for side in SIDES}
        self._hips[""] = np.mean(list(self._hips.values()), axis=0)
        self._trunk = placed[names.index("thorax")] - pelvis if "thorax" in names else np.zeros(3)

    def placed(self, segment: str, position: FloatArray, name: str) -> FloatArray:
        """Return (3,) m on the person's segment. name: of the wire's point, which begins with the
        muscle's."""
        if segment in self._tips:
            bone = self._model_tips[segment]
            along = float(position @ bone / (bone @ bone))
            moved: FloatArray = along * self._tips[segment] + self.size * (position - along * bone)
            return moved
        scaled: FloatArray = self.size * position
        if segment == "pelvis":
            scaled = scaled + self._hips[_hip_of(name)]
        if segment == "thorax":
            scaled = scaled + self._hips[""] - self._trunk
        return scaled

    def patella(self, side: str) -> FloatArray:
        """Return (3,) m where the patella's way begins, in axes of the thigh."""
        begun: FloatArray = self._tips[f"{side}thigh"] + self.size * self._patella_at[side]
        return begun


def absent_segments(skeleton: Skeleton) -> list[str]:
    """Return segments that muscles need and the body does not have."""
    wanted = ["pelvis", *(side + part for side in SIDES for part in ("thigh", "shank", "foot"))]
    return [name for name in wanted if name not in skeleton.segment_names]


def _hip_of(name: str) -> str:
    """Return the hip that a muscle's points on the pelvis are told from."""
    return "" if name.startswith(TRUNK) else "left_" if "_l_" in name else "right_"


def _bodies(world: Element, skeleton: Skeleton) -> dict[str, Element]:
    bodies: dict[str, Element] = {}
    for s, name in enumerate(skeleton.segment_names):
        parent = int(skeleton.parents[s])
        under = world if parent < 0 else bodies[skeleton.segment_names[parent]]
        body = SubElement(under, "body", name=name, pos=_text(skeleton.offsets[s]))
        SubElement(body, "joint", name=name, type="free" if parent < 0 else "ball")
        SubElement(body, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
        bodies[name] = body
    return bodies


def _patella(thigh: Element, side: str, scaling: _Scaling) -> Element:
    body = SubElement(thigh, "body", name=side + PATELLA, pos=_text(scaling.patella(side)))
    for joint, kind, axis in zip(
        _JOINTS, ("slide", "slide", "hinge"), ("1 0 0", "0 1 0", "0 0 1"), strict=True
    ):
        SubElement(body, "joint", name=f"{side}{PATELLA}_{joint}", type=kind, axis=axis)
    SubElement(body, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
    return body


def _text(values: FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)
