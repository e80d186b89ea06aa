"""A body as a mujoco model: a free root, a ball joint to each other segment, the masses of its parts.

Ball joints have no singularity whatever the joint's angles are called; ``joint_torques`` lays their moments
along those angles' axes.
"""

from __future__ import annotations

import importlib.util
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from devices.extras import how_to_add
from gateway.body.inertia import BodyInertia
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray

EXTRA = how_to_add("biomech")


def require_biomech() -> None:
    """Raise ``GatewayError`` where the extra is not installed."""
    absent = [name for name in ("mujoco", "osqp") if importlib.util.find_spec(name) is None]
    if absent:
        raise GatewayError(f"the analysis needs {' and '.join(absent)} (extra 'biomech'): {EXTRA}")


def body_mjcf(skeleton: Skeleton, inertia: BodyInertia, gravity: FloatArray) -> str:
    """Return the model's text. gravity: (3,) m/s², world axes."""
    model = Element("mujoco", model=skeleton.name)
    SubElement(model, "compiler", angle="radian", balanceinertia="false")
    option = SubElement(model, "option", gravity=_text(gravity))
    SubElement(option, "flag", contact="disable", constraint="disable")
    world = SubElement(model, "worldbody")
    bodies: list[Element] = []
    for s, name in enumerate(skeleton.segment_names):
        parent = int(skeleton.parents[s])
        body = SubElement(world if parent < 0 else bodies[parent], "body", name=name)
        body.set("pos", _text(skeleton.offsets[s]))
        kind = "free" if parent < 0 else "ball"
        SubElement(body, "joint", name=name, type=kind)
        SubElement(
            body, "inertial", mass=repr(float(inertia.mass[s])), pos=_text(inertia.centre[s]),
            fullinertia=_text(_upper(inertia.inertia[s])),
        )  # fmt: skip
        bodies.append(body)
    return tostring(model, encoding="unicode")


def compiled_model(skeleton: Skeleton, inertia: BodyInertia, gravity: FloatArray) -> Any:
    """Return ``mujoco.MjModel``. Raises ``GatewayError`` without mujoco, or for masses that no body
    can have."""
    require_biomech()
    import mujoco  # noqa: PLC0415 - an extra

    try:
        return mujoco.MjModel.from_xml_string(body_mjcf(skeleton, inertia, gravity))
    except ValueError as error:
        raise GatewayError(f"body '{skeleton.name}' makes no dynamic model: {error}") from error


def _upper(inertia: FloatArray) -> FloatArray:
    """Return xx, yy, zz, xy, xz, yz of an inertia (3, 3), kg m²."""
    upper: FloatArray = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return upper


def _text(values: FloatArray) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values))
