"""A fast arm of five segments with known truth, each kind of error a switch of its own.

After two seconds of rest every joint turns about all its axes, sums of sines of incommensurate frequencies.
On a fixed base the last modules feel 30 to 60 m/s² RMS, as in throwing or boxing; on a base that is carried
about, whose position a local device measures, all modules feel about as much. Frames come straight from the
sensors' equations, at instants that the clock residue moves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from devices.deferred import Rotation, lfilter
from devices.emulators.bodies import EmulatedBody
from devices.emulators.motion.motions import BodyMotion, generic_motion
from devices.emulators.motion.waves import Waves
from devices.emulators.sensing.ideal_sensors import SensorValues, sense
from gateway.body.skeleton import LocalDevice, Skeleton, WornSuit, field_vector
from gateway.emulation.rig import dress
from gateway.frames import FloatArray, ImuFrame, LocalReading, Quantity

RATE_HZ = 100.0
SECONDS = 30.0
LENGTHS_M = (0.35, 0.30, 0.25, 0.20, 0.15)
FIELD = field_vector(50.0, 65.0)
PEAK_RATE = 19.0
PEAK_ANGULAR_ACCELERATION = 190.0
WOBBLE_HZ = 7.0
WOBBLE_DAMPING = 0.3
POSITION_DEVICE = 60
POSITION_SIGMA_M = 0.001


@dataclass(frozen=True)
class Switches:
    """What is wrong; all of it by default. Standard deviations unless said otherwise."""

    has_noise: bool = True
    """White noise: 0.03 m/s², 0.1 °/s, 0.5 µT."""
    has_bias: bool = True
    """0.05 m/s², 0.3 °/s and a walk of 0.005 °/s/√s."""
    has_scale: bool = True
    """Scale errors of 0.2 % an axis."""
    lever_arm_m: float = 0.01
    """Each component of where a module really sits."""
    device_m: float = 0.0
    """The same of a position device."""
    device_sigma_m: float = POSITION_SIGMA_M
    """Noise of its readings, which it claims."""
    device_every_s: float = 0.0
    """Its readings come that far apart; 0: with every frame."""
    has_wobble: bool = False
    """Soft tissue: the module swings on its segment, about 2° and 4 mm RMS."""
    clock_residue_s: float = 0.0
    """Each module samples that much early or late throughout."""
    is_field_disturbed: bool = False
    """Iron near the base: the field is bent by up to tens of degrees, otherwise at every place."""


IDEAL = Switches(has_noise=False, has_bias=False, has_scale=False, lever_arm_m=0.0)
ALL_ON = Switches(has_wobble=True, clock_residue_s=100e-6, is_field_disturbed=True)


def fast_arm() -> WornSuit:
    """Return five links in a row, a module beside the middle of each, the base a fixed point."""
    n = len(LENGTHS_M)
    lengths = np.array(LENGTHS_M)
    offsets, tips, lever_arms = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    offsets[1:, 2], tips[:, 2] = lengths[:-1], lengths
    lever_arms[:, 0], lever_arms[:, 2] = 0.03, 0.5 * lengths
    names = tuple(f"link_{i + 1}" for i in range(n))
    return WornSuit(
        skeleton=Skeleton("fast_arm", names, np.arange(n) - 1, offsets, tips),
        module_ids=tuple(range(n)),
        module_of_segment=np.arange(n),
        sensor_to_segment=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        lever_arms=lever_arms,
        local_devices=(LocalDevice(Quantity.FIXED_POINT, 0, np.zeros(3)),),
        gravity=np.array([0.0, 0.0, -9.81]),
        magnetic_field=FIELD,
    )


def carried_arm() -> WornSuit:
    """Return the same arm with a local device that measures the position of its base."""
    device = LocalDevice(Quantity.POSITION, 0, np.zeros(3), POSITION_DEVICE)
    return replace(fast_arm(), local_devices=(device,))


def carried_motion(suit: WornSuit, seed: int) -> BodyMotion:
    """Return all joints about all axes, and the base along all: every module feels 30 to 60 m/s² RMS."""
    rng = np.random.default_rng([seed, 11])

    def waves(rows: int, amplitude: tuple[float, float]) -> Waves:
        shape = (rows, 3, 2)
        frequency, phase = rng.uniform(0.6, 1.6, shape), rng.uniform(0.0, 2.0 * np.pi, shape)
        return Waves(rng.uniform(*amplitude, shape), frequency, phase)

    return BodyMotion(dress(suit), waves(len(LENGTHS_M), (0.15, 0.45)), waves(1, (0.25, 0.45)))


def fast_motion(suit: WornSuit, seed: int) -> BodyMotion:
    """Return all joints about all axes."""
    return generic_motion(
        dress(suit), seed, peak_angular_rate=PEAK_RATE, peak_angular_acceleration=PEAK_ANGULAR_ACCELERATION
    )


def felt(observed: list[ImuFrame]) -> FloatArray:
    """Return the RMS of each module's specific force once in motion, (n,) m/s²."""
    force = np.stack([frame.specific_force for frame in observed if frame.time_ns >= 4e9])
    rms: FloatArray = np.sqrt(np.mean(np.sum(force**2, axis=2), axis=0))
    return rms


def sampled(
    suit: WornSuit,
    motion: BodyMotion,
    switches: Switches,
    seed: int,
    rate_hz: float = RATE_HZ,
    seconds: float = SECONDS,
) -> list[ImuFrame]:
    """Return all frames of a chain, sensor axes; where a local device measures a position, its readings too.

    suit: any whose modules are those of its segments, in their order and with their axes.
    """
    n, rng = suit.skeleton.n_segments, np.random.default_rng([seed, 7])
    times = np.arange(round(seconds * rate_hz)) / rate_hz
    at = times[:, None] + switches.clock_residue_s * rng.standard_normal(n)
    state = motion.module_state(np.arange(n), at)
    body: EmulatedBody = dress(suit)
    arms = body.module_positions + switches.lever_arm_m * rng.standard_normal((n, 3))
    R_bs = np.tile(np.eye(3), (n, 1, 1))
    # Modules sit where the drawn arms say; the method is given the nominal ones.
    values = sense(state, arms, R_bs, suit.gravity, suit.magnetic_field)
    if switches.is_field_disturbed:
        bent = _bent_field(state.joint_position, suit.magnetic_field)
        field = (np.swapaxes(state.R_wb, -1, -2) @ bent[..., None])[..., 0]
        values = replace(values, magnetic_field=field)
    if switches.has_wobble:
        values = _wobbling(values, rng, 1.0 / rate_hz)
    frames = _frames(times, _measured(values, switches, rng, 1.0 / rate_hz))
    for device in suit.local_devices:
        if device.quantity is Quantity.POSITION:
            frames = _with_positions(frames, device, motion, times, switches, rng)
    return frames


def _with_positions(
    frames: list[ImuFrame],
    device: LocalDevice,
    motion: BodyMotion,
    times: FloatArray,
    switches: Switches,
    rng: np.random.Generator,
) -> list[ImuFrame]:
    """Return the frames with a position device's readings."""
    state, sigma_m = motion.state(times), switches.device_sigma_m
    place = device.position + switches.device_m * rng.standard_normal(3)
    measured = state.joint_position[:, device.segment] + state.R_wb[:, device.segment] @ place
    measured += sigma_m * rng.standard_normal(measured.shape)
    sigma, next_s, result = np.full(3, sigma_m), 0.0, []
    for frame, time_s, at in zip(frames, times, measured, strict=True):
        local: tuple[LocalReading, ...] = ()
        if time_s >= next_s:
            next_s += switches.device_every_s
            local = (LocalReading(POSITION_DEVICE, frame.time_ns, Quantity.POSITION, at, sigma),)
        result.append(replace(frame, local=local))
    return result


def _bent_field(positions: FloatArray, field: FloatArray) -> FloatArray:
    """Return world field at places (T, n, 3) near a dipole half a metre beside the base, µT."""
    moment = np.array([3.0, -2.0, 1.5])
    away = positions - np.array([0.6, -0.5, -0.4])
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    unit = away / distance
    bent: FloatArray = field + (3.0 * unit * (unit @ moment)[..., None] - moment) / distance**3
    return bent


def _wobbling(values: SensorValues, rng: np.random.Generator, dt: float) -> SensorValues:
    """Return the module on a spring: what its shaking adds to force and rate, and its turned axes."""
    omega = 2.0 * np.pi * WOBBLE_HZ
    decay = np.exp(-WOBBLE_DAMPING * omega * dt)
    turn = omega * np.sqrt(1.0 - WOBBLE_DAMPING**2) * dt
    a = [1.0, -2.0 * decay * np.cos(turn), decay**2]
    driven = lfilter([sum(a) / omega**2], a, values.specific_force - values.specific_force[0], axis=0)
    shift = -0.2 * driven  # a fifth of the module's weight is carried by tissue
    shaking = np.gradient(np.gradient(shift, dt, axis=0), dt, axis=0)
    lever = rng.normal(0.0, 3.5, (shift.shape[1], 3))  # rad/m
    angle = np.cross(lever, shift)
    rate = values.angular_rate + np.gradient(angle, dt, axis=0)
    back = Rotation.from_rotvec(-angle.reshape(-1, 3))

    def turned(vectors: FloatArray) -> FloatArray:
        return np.asarray(back.apply(vectors.reshape(-1, 3)).reshape(vectors.shape))

    return SensorValues(turned(values.specific_force + shaking), turned(rate), turned(values.magnetic_field))


def _measured(values: SensorValues, switches: Switches, rng: np.random.Generator, dt: float) -> SensorValues:
    shape = values.specific_force.shape

    def read(true: FloatArray, noise: float, bias: float, walk: float) -> FloatArray:
        result = true.copy()
        if switches.has_scale:
            result *= 1.0 + 0.002 * rng.standard_normal(shape[1:])
        if switches.has_bias:
            result += bias * rng.standard_normal(shape[1:])
            result += walk * np.sqrt(dt) * np.cumsum(rng.standard_normal(shape), axis=0)
        if switches.has_noise:
            result += noise * rng.standard_normal(shape)
        return result

    return SensorValues(
        read(values.specific_force, 0.03, 0.05, 0.0),
        read(values.angular_rate, np.radians(0.1), np.radians(0.3), np.radians(0.005)),
        read(values.magnetic_field, 0.5, 0.0, 0.0),
    )


def _frames(times: FloatArray, values: SensorValues) -> list[ImuFrame]:
    n = values.specific_force.shape[1]
    status, gap = np.zeros(n, np.uint8), np.zeros(n, np.int64)
    return [
        ImuFrame(k, round(t * 1e9), f, w, m, status, gap)
        for k, (t, f, w, m) in enumerate(
            zip(times, values.specific_force, values.angular_rate, values.magnetic_field, strict=True)
        )
    ]
