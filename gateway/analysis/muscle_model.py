"""Muscles of the legs and the trunk, as wires from a published model.

The model is ``myolegs_abdomen`` of the package ``myo-sim`` (Apache-2.0; legs after Rajagopal et al. 2016,
IEEE Trans. Biomed. Eng. 63(10): 2068–2079, MIT; trunk after Delp et al. 1990): 80 muscles of the legs, 6 of
the trunk. Its arms come from a source for non-commercial use only and are not touched. Its segments' axes are
ours (x forward, y up, z to the right, all parallel when standing), so its wires are only shifted and scaled.
"""

from __future__ import annotations

import importlib.util
import logging
import warnings
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from gateway.analysis.body_model import EXTRA, require_biomech
from gateway.analysis.smooth_motion import matrices
from gateway.errors import GatewayError
from gateway.frames import FloatArray

_log = logging.getLogger(__name__)

MODEL = "myolegs_abdomen"
_SEGMENTS = {
    "sacrum": "pelvis", "pelvis": "pelvis", "lumbar5": "thorax", "femur": "thigh", "patella": "patella",
    "tibia": "shank", "talus": "foot", "calcn": "foot", "toes": "foot",
}  # fmt: skip
"""The model's bodies to our segments, without sides."""
_ORIGINS = {"shank": "tibia", "thigh": "femur", "foot": "talus"}
PATELLA = "patella"
TRUNK = ("ercspn", "intobl", "extobl")
"""How names of muscles of the trunk begin."""
_SIDES = {"_l": "left_", "_r": "right_"}
WRAP_SPHERE = 4
"""In mujoco's kinds of what a wire slides over; a cylinder is the next."""
_GAINS = 9
_PEAK_FORCE = 2
"""In the parameters of a muscle's gain."""


@dataclass(frozen=True)
class WirePoint:
    """A point that a wire goes through, or a body that it slides over."""

    segment: str
    """Ours; ``left_patella`` and ``right_patella`` ride on the thighs."""
    position: FloatArray  # (3,) m from the segment's proximal joint in the model's size, segment axes
    rotation: FloatArray | None = None  # (3, 3) of the body wrapped over; None: a point
    radius_m: float = 0.0
    is_sphere: bool = False
    side: FloatArray | None = None
    """(3,) a point on the side of the body where the wire goes; None: whichever is shorter."""
    side_segment: str = ""


@dataclass(frozen=True)
class Wire:
    """One muscle."""

    name: str
    peak_force_n: float
    """Isometric, at its best length."""
    points: tuple[WirePoint, ...]
    gain: FloatArray
    """(9,) of mujoco's muscle: how the force follows length and speed."""
    length_range: FloatArray
    """(2,) m between which the model's wire can be."""
    standing_length_m: float
    """Of the model's wire, in its standing posture."""


@dataclass(frozen=True)
class MuscleModel:
    """All muscles, and the sizes that they belong to."""

    wires: tuple[Wire, ...]
    tips: dict[str, FloatArray]
    """(3,) m from joint to joint of ``left_thigh``, ``left_shank`` and so on."""
    patella: dict[str, FloatArray]
    """(3, 5) by side (``left_``): coefficients, lowest power first, of its shift along x and y, m, and of its
    turn about z, rad, over the knee's flexion, rad."""
    patella_at: dict[str, FloatArray]
    """(3,) m by side: where those shifts begin, from the knee's centre, in axes of the thigh."""


@cache
def muscle_model() -> MuscleModel:
    """Return the muscles of ``myo-sim``.

    Raises ``GatewayError`` where it is not installed, or holds another model than this."""
    require_biomech()
    if importlib.util.find_spec("myo_sim") is None:
        raise GatewayError(f"muscles need myo-sim (extra 'biomech'): {EXTRA}")
    import mujoco  # noqa: PLC0415 - an extra
    import myo_sim  # noqa: PLC0415

    mujoco.set_mju_user_warning(_log.debug)  # it warns of saving the model, which nobody does
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = myo_sim.load_spec(MODEL).compile()
    finally:
        mujoco.set_mju_user_warning(None)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    try:
        return _Reader(model, data).muscles()
    except (KeyError, IndexError) as error:
        raise GatewayError(
            f"the installed myo-sim holds another model '{MODEL}' than is known here ({error}); a version "
            f"0.2 is wanted: {EXTRA}"
        ) from error


class _Reader:
    """Takes wires out of the compiled model, in its standing posture."""

    def __init__(self, model: Any, data: Any) -> None:
        self._model = model
        self._places, self._axes = data.xpos, data.xmat.reshape(-1, 3, 3)[model.body("pelvis").id]
        hips = [self._at(f"femur{side}") for side in _SIDES]
        self._hips = {"left_": hips[0], "right_": hips[1], "": 0.5 * (hips[0] + hips[1])}

    def muscles(self) -> MuscleModel:
        """Return all wires, each point in the axes of its body from the joint that the body hangs on."""
        model = self._model
        wires = []
        for i in range(model.nu):
            tendon = int(model.actuator_trnid[i, 0])
            name = model.actuator(i).name
            start, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
            points = tuple(self._point(w, _side(name)) for w in range(start, start + count))
            gain = model.actuator_gainprm[i, :_GAINS].copy()
            wires.append(
                Wire(
                    name, float(gain[_PEAK_FORCE]), points, gain, model.actuator_lengthrange[i].copy(),
                    float(model.tendon_length0[tendon]),
                )
            )  # fmt: skip
        tips = {}
        for end, side in _SIDES.items():
            hip, knee, ankle = (self._at(f"{body}{end}") for body in ("femur", "tibia", "talus"))
            tips[f"{side}thigh"], tips[f"{side}shank"] = knee - hip, ankle - knee
        return MuscleModel(
            tuple(wires), tips, {side: self._patella(end) for end, side in _SIDES.items()},
            {side: self._patella_at(end) for end, side in _SIDES.items()},
        )  # fmt: skip

    def _at(self, body: str) -> FloatArray:
        """Return (3,) m, where a body's origin is, in the axes of all bodies."""
        place: FloatArray = self._axes.T @ self._places[self._model.body(body).id]
        return place

    def _point(self, wrap: int, muscle_side: str) -> WirePoint:
        model, thing = self._model, int(self._model.wrap_objid[wrap])
        kind = int(model.wrap_type[wrap])
        if kind not in (WRAP_SPHERE, WRAP_SPHERE + 1):
            segment, place = self._placed(int(model.site_bodyid[thing]), model.site_pos[thing], muscle_side)
            return WirePoint(segment, place)
        segment, place = self._placed(int(model.geom_bodyid[thing]), model.geom_pos[thing], muscle_side)
        turn = matrices(model.geom_quat[thing][None])[0]
        beside, side_segment = None, ""
        if (site := round(float(model.wrap_prm[wrap]))) >= 0:
            side_segment, beside = self._placed(
                int(model.site_bodyid[site]), model.site_pos[site], muscle_side
            )
        radius = float(model.geom_size[thing, 0])
        return WirePoint(segment, place, turn, radius, kind == WRAP_SPHERE, beside, side_segment)

    def _placed(self, body: int, position: FloatArray, muscle_side: str) -> tuple[str, FloatArray]:
        """Return our segment, and the place from its proximal joint; on the pelvis and the trunk from the hip
        of the muscle's side, or the middle of both for muscles of the trunk."""
        name = self._model.body(body).name
        side = _side(name)
        segment = _SEGMENTS[name.removesuffix(name[-2:]) if side else name]
        here: FloatArray = self._at(name) + position
        if segment in ("pelvis", "thorax"):
            return segment, here - self._hips[muscle_side if name == "pelvis" else ""]
        if segment == PATELLA:  # it turns against the thigh: in its own axes
            return side + segment, position
        return side + segment, here - self._at(_ORIGINS[segment] + name[-2:])

    def _patella_at(self, side: str) -> FloatArray:
        bodies = [self._model.body(f"{name}{side}").id for name in ("patella", "tibia")]
        patella, knee = self._model.body_pos[bodies]
        begun: FloatArray = patella - knee
        return begun

    def _patella(self, side: str) -> FloatArray:
        """Return the joints' polynomials over the knee's angle."""
        model = self._model
        rows = []
        for joint in ("translation1", "translation2", "rotation1"):
            wanted = model.joint(f"knee_angle_beta_{joint}{side}").id
            which = int(np.flatnonzero(model.eq_obj1id[: model.neq] == wanted)[0])
            rows.append(model.eq_data[which, :5])
        return np.array(rows)


def _side(name: str) -> str:
    """Return ``left_``, ``right_`` or empty, by the end of a name of the model."""
    return _SIDES.get(name[-2:], "")
