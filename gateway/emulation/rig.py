"""A rig of the gateway as the body that an emulated suit moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from devices.emulators.bodies import NO_MODULE, EmulatedBody, EmulatedLocalDevice, emulated_body
from devices.emulators.motion.calibrating import calibration_motion
from devices.emulators.motion.gait import WALK
from devices.emulators.motion.motions import (
    BodyMotion,
    everyday_motion,
    gait_motion,
    generic_motion,
    pendulum_motion,
    robot_arm_motion,
)
from devices.emulators.motion.tumbling import TumblingMotion
from devices.emulators.sensing.light_sampler import Sunlight
from gateway.body.skeleton import LocalDevice, WornSuit
from gateway.frames import Quantity
from gateway.geometry import quaternion
from gateway.sources.light import sun_direction

LOCAL_RATE_HZ = 100.0

MOTIONS: dict[str, Callable[[EmulatedBody, int], BodyMotion]] = {
    "human_17": gait_motion,
    "human_23": gait_motion,
    "lower_body_7": gait_motion,
    "pendulum_3": pendulum_motion,
    "robot_arm_4": robot_arm_motion,
}
"""Motion that suits a body; any other body moves its joints at random."""

CIRCLING = replace(WALK, radius=2.0)
"""Once round in 12 s."""

LOCAL_SIGMA = {
    Quantity.ACCELERATION: 0.05,
    Quantity.VELOCITY: 0.02,
    Quantity.POSITION: 0.002,
    Quantity.AIR_VELOCITY: 0.2,
}
"""Noise of an emulated local measuring device, in its quantity's unit (pressure tubes: Pa)."""


def dress(suit: WornSuit, local_sigma: dict[Quantity, float] | None = None) -> EmulatedBody:
    """Return the suit's skeleton and modules as plain data for the emulator."""
    skeleton = suit.skeleton
    sigma = LOCAL_SIGMA if local_sigma is None else local_sigma
    ids = [suit.module_ids[row] if row >= 0 else NO_MODULE for row in suit.module_of_segment]
    return emulated_body(
        skeleton.segment_names,
        skeleton.parents,
        skeleton.offsets,
        module_positions=suit.lever_arms,
        sensor_to_segment=suit.sensor_to_segment,
        module_ids=ids,
        reference_posture=np.tile(skeleton.neutral, (skeleton.n_segments, 1)),
        local_devices=tuple(
            _local_device(device, sigma.get(device.quantity, 0.0))
            for device in suit.local_devices
            if device.device is not None
        ),
        contacts=skeleton.contacts,
    )


def worn_wrong(body: EmulatedBody, upside_down: Sequence[int], swapped: Sequence[int]) -> EmulatedBody:
    """Return the body with modules of these ids upside down, and two that have changed places.

    Raises ``ValueError`` for a module that it does not wear."""
    ids, alignment = body.module_ids.copy(), body.sensor_to_segment.copy()
    for module in (*upside_down, *swapped):
        if module not in ids:
            raise ValueError(f"no module {module} is worn; these are: {', '.join(map(str, sorted(ids)))}")
    for module in upside_down:
        segment = int(np.flatnonzero(ids == module)[0])
        alignment[segment] = quaternion.multiply(_ABOUT_FORWARD, alignment[segment])
    if swapped:
        at = [int(np.flatnonzero(ids == module)[0]) for module in swapped]
        ids[at] = ids[at[::-1]]
    return replace(body, module_ids=ids, sensor_to_segment=alignment)


_ABOUT_FORWARD = np.array([0.0, 1.0, 0.0, 0.0])
"""Half a turn."""


def move(body: EmulatedBody, body_name: str, seed: int) -> BodyMotion:
    """Return a motion that suits the body: walking for people, swinging for pendulums."""
    return MOTIONS.get(body_name, generic_motion)(body, seed)


def move_about(body: EmulatedBody, body_name: str, seed: int) -> BodyMotion:
    """Move as ``move`` does, but people walk in a circle to their left, and so stay near for who looks on."""
    if MOTIONS.get(body_name) is gait_motion:
        return gait_motion(body, seed, gait=CIRCLING)
    return move(body, body_name, seed)


def perform(body: EmulatedBody, body_name: str, seed: int) -> BodyMotion:
    """Move with more to see: people walk, turn, reach out and squat."""
    if MOTIONS.get(body_name) is gait_motion:
        return everyday_motion(body, seed)
    return move(body, body_name, seed)


def calibrate(body: EmulatedBody, _body_name: str, seed: int, heading: float = 0.0) -> BodyMotion:
    """Return the steps of ``calibrate body``, over and over; ``heading`` in rad from east."""
    return calibration_motion(body, seed, heading)


def tumble(body: EmulatedBody, _body_name: str, seed: int) -> BodyMotion:
    """Return the suit in a box that is put on all sides and turned: for calibrating sensors."""
    return TumblingMotion(body, seed)


def _local_device(device: LocalDevice, sigma: float) -> EmulatedLocalDevice:
    assert device.device is not None
    return EmulatedLocalDevice(
        module=device.device,
        segment=device.segment,
        position=device.position,
        quantity=int(device.quantity),
        sigma=sigma,
        rate_hz=LOCAL_RATE_HZ,
        orientation=device.orientation,
    )


def sunlight(suit: WornSuit, time_ns: int) -> Sunlight | None:
    """Return what the suit's photoelectric cells see at a time (UTC, ns since 1970); None: they are not in
    use. The cells of all emulated modules look where those of the first one do."""
    if suit.sun is None:
        return None
    direction = sun_direction(time_ns, suit.sun.latitude_deg, suit.sun.longitude_deg)
    light = Sunlight(direction, normals=suit.sun.normals[0])
    is_day = direction[2] > 0.0
    return light if is_day else replace(light, direct=0.0, sky=0.0, ground=0.0)
