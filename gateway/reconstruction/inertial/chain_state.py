"""What the chain filters know and remember: the body, the noise, the state. All plain arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, IntArray, Quantity
from gateway.reconstruction.inertial.chain_bridges import bridges_of

N_READINGS = 12
"""Readings of a local device that a derivative is fitted to, at most."""
N_HISTORY = 96
"""Frames remembered of the segment that carries a local device."""
N_OF_FRAME = 16
"""Numbers remembered of each."""
OPEN_SIGMA = 1.6
"""rad: a heading of which nothing is known."""


class Noise(NamedTuple):
    """One set for all bodies and motions; per axis, one standard deviation."""

    specific_force: float = 0.1
    """m/s²: what a row of accelerations is off by besides the lever arms. Sensors are several times better;
    this is play of joints and clock residue."""
    lever_arm: float = 0.01
    """m: by how much a lever arm changes while the body moves (soft tissue), times ‖[ω̇, ω]‖."""
    lever_arm_offset: float = 0.02
    """m: how far a lever arm was measured wrong; what of it shows in the motion is found out."""
    force_bias: float = 0.05
    """m/s²: constant error of an accelerometer after its calibration; found where a known point shows it."""
    row_memory_s: float = 0.1
    """For how long a row stays off to the same side: denser rows say no more in all."""
    huber: float = 2.0
    """Standard deviations beyond which a row counts linearly, no longer quadratically."""
    smoothing_s: float = 0.05
    """Time constant of the low-pass through which both sides of a row go: bandwidth 3 Hz."""
    gyrometer: float = 0.001
    """rad/s/√Hz: consumer sensors have 0.0002; sampling at tens of Hz and aliasing add."""
    gyrometer_scale: float = 0.006
    """Relative error of scale and axes."""
    scale_memory_s: float = 0.5
    """For how long a scale error keeps its effect in a motion to and fro."""
    bias: float = 0.01
    """rad/s at the start: half a degree per second, as after a factory calibration."""
    bias_walk: float = 2e-4
    """rad/s/√s."""
    start_tilt: float = 0.3
    """rad: of a first orientation from one specific force."""
    heading: float = 0.1
    """rad: how far the field's heading is off at the most where it does not change from place to place; where
    its norm and dip change, that is added."""
    heading_offset_s: float = 300.0
    """Within it that is another one; until then it is found."""
    heading_memory_s: float = 10.0
    """For how long changes stay off to the same side, and what is not yet found."""
    start_heading: float = 0.5
    """rad: how far it may be off throughout: what a first heading by the field counts against the motion."""
    unaided_speed: float = 0.3
    """m/s: how fast a body moves whose acceleration nothing tells; one that was aided may have shown more."""
    unaided_window_s: float = 1.0
    """Over it the mean acceleration is that speed over the window."""
    starting_share: float = 0.1
    """Of the square of what a first sample shows of acceleration: how much of it lasts over that window."""
    starting_memory_s: float = 2.0
    """For how long that is expected."""
    local_window_s: float = 0.2
    """Least span of readings of a local device that an acceleration is fitted to: bandwidth about 5 Hz."""
    local_acceleration: float = 0.2
    """m/s²: the span is so long that the readings' noise leaves no more than that, where it can be."""
    heading_evidence: float = 20.0
    """Concentration (von Mises) from which an open heading is taken as shown."""
    heading_coherence: float = 0.6
    """Least agreement of the two sides' horizontal accelerations for that."""
    heading_time_s: float = 1.0
    """For how long it must have been gathered: what one swing tells is off to one side."""
    rest_rate: float = 0.035
    """rad/s: less change of the rate than this, for ``REST_S``, is rest."""
    dead_rate: float = 2.0
    """rad/s: how a segment turns while its module is silent."""
    largest_rate: float = 34.8
    """rad/s: beyond it (2000 °/s less rounding) a gyrometer is saturated."""
    largest_force: float = 156.0
    """m/s²: beyond it (16 g less rounding) an accelerometer is saturated."""


class ChainBody(NamedTuple):
    """Constant."""

    parents: IntArray  # (n,) nearest one towards the root with a module; −1: none, or has none itself
    opens: IntArray  # (n,) 1 where motion can show the heading: against the parent, or by a device on a root
    to_joint: FloatArray  # (n, 3) module to proximal joint, own axes, m
    from_parent: FloatArray  # (n, 3) parent's module to this joint, parent's axes, m
    is_bridged: IntArray  # (n,) 1 where segments without module lie between; see ``chain_bridges``
    beyond: FloatArray  # (n, 3) of those, what turns with this segment, own axes, m
    slack: FloatArray  # (n,) by how much the joint beyond them may be elsewhere, m
    device_segment: IntArray  # (d,)
    device_kind: IntArray  # (d,) Quantity
    device_arm: FloatArray  # (d, 3) module to device, segment axes, m
    carries: IntArray  # (n,) 1 for segments that stand on the ground
    gravity: FloatArray  # (3,)
    at_rest: FloatArray  # (3,) specific force of what does not accelerate: −gravity
    field: FloatArray  # (3,)
    uses_field: bool


class FilterState(NamedTuple):
    """By segment, changed in place. Averages are world vectors and turn with every correction."""

    time_ns: IntArray  # (2,) of the last frame and of the first; −1: none yet
    is_started: IntArray  # (n,) 0: no, 1: yes, 2: yes, but silent for so long that it begins anew
    is_open: IntArray  # (n,) heading not yet shown: against the parent, of a root against the world
    silent_s: FloatArray  # (n,) since the module's last sample
    fresh_s: FloatArray  # (n,) since the averages were begun
    R: FloatArray  # (n, 3, 3)
    bias: FloatArray  # (n, 3)
    force_bias: FloatArray  # (n, 3) found error of the accelerometer, m/s², of segments with a local device
    P: FloatArray  # (n, 6, 6)
    C: FloatArray  # (n, 6, 6)
    rate: FloatArray  # (n, 3) last measured, bias included
    slope: FloatArray  # (n, 3) its change over the last step, rad/s²; NaN: not known
    force: FloatArray  # (n, 3) average of R f
    last_force: FloatArray  # (n, 3) R f of the frame before
    long_force: FloatArray  # (n, 3) the same over the unaided window
    swing: FloatArray  # (n, 3, 3) average of R [ω]×
    arm: FloatArray  # (n, 6) found errors of to_joint and from_parent, m
    arm_covariance: FloatArray  # (n, 6, 6) their covariance
    arm_variance: FloatArray  # (n,) what that meant for a component of the joint's row when asked, (m/s²)²
    learnt_s: FloatArray  # (n,) since that; infinite: never
    compass_s: FloatArray  # (n,) for how long an undisturbed field has been seen
    field_seen: FloatArray  # (n, 9) field's mean norm µT and dip rad, mean square of their changes, seconds;
    # mean changes of norm (relative) and dip, rad, and these of now; mean square of what they are wrong by
    field_offset: FloatArray  # (n, 2) heading by which the field is off throughout, rad; its variance
    heading: FloatArray  # (n, 4) cosine and sine sums of an open heading, their possible length; seconds
    rest: FloatArray  # (n, 10) average rate, force, their variances, seconds at rest, and see ``rest_rows``
    device_shift: FloatArray  # (d, 3) found error of a device's arm, m
    device_covariance: FloatArray  # (d, 6, 6) its covariance and that of the accelerometer's error
    device_age_s: FloatArray  # (d,) since the device last told something
    device_fit: (
        FloatArray  # (d, 2) span of its readings that a fit takes, s; what the last one left, (m/s²)² s
    )
    readings: FloatArray  # (d, N_READINGS, 5) seconds of frame time, value, standard deviation
    n_readings: IntArray  # (d, 2) how many; 1 while the last one waits for its frames
    history: FloatArray  # (d, N_HISTORY, N_OF_FRAME) time, R f, the columns of R, ω: of the device's segment,
    device_turn: FloatArray  # (d, 3, 3) of these into the world: all corrections since the first of them
    unaided_square: FloatArray  # (n,) mean square acceleration over the unaided window while aided, (m/s²)²
    starting_square: FloatArray  # (n,) the same as a start in motion lets expect, less and less with time
    sun: FloatArray  # (n, 3) cosine and sine sums of the headings that the sun showed, their length; seconds
    vibration: FloatArray  # (n, 14) mean square, samples, and the last four of each axis, see ``vibration``
    corrections: FloatArray  # (n, 9) horizontal sums of this block and of the one before, seconds; means of
    # their product and square; doubts of the gyrometer, of rows
    misfit: FloatArray  # (n,) of the joint to the parent: mean square of its residual over what is expected


def initial_state(n: int, d: int) -> FilterState:
    """Nothing known, of n segments and d devices."""

    def z(*shape: int) -> FloatArray:
        return np.zeros(shape)

    return FilterState(
        np.full(2, -1, np.int64), np.zeros(n, np.int64), np.ones(n, np.int64), z(n), z(n),
        z(n, 3, 3), z(n, 3), z(n, 3), z(n, 6, 6), z(n, 6, 6),
        z(n, 3), z(n, 3), z(n, 3), z(n, 3), z(n, 3), z(n, 3, 3),
        z(n, 6), z(n, 6, 6), z(n), np.full(n, np.inf),
        z(n), z(n, 9), z(n, 2), z(n, 4), z(n, 10), z(d, 3), z(d, 6, 6), np.full(d, np.inf), z(d, 2),
        z(d, N_READINGS, 5), np.zeros((d, 2), np.int64),
        np.full((d, N_HISTORY, N_OF_FRAME), -np.inf), np.tile(np.eye(3), (d, 1, 1)),
        z(n), z(n), z(n, 3), z(n, 14), z(n, 9), z(n),
    )  # fmt: skip


def chain_body(suit: WornSuit, uses_field: bool) -> ChainBody:
    """The suit as the filters see it. Devices on segments without module tell nothing and are left out."""
    skeleton = suit.skeleton
    has_module = suit.module_of_segment >= 0
    bridges = bridges_of(suit)
    parents, joined = bridges.parents, bridges.parents >= 0
    devices = [device for device in suit.local_devices if has_module[device.segment]]
    lever_arms = np.asarray(suit.lever_arms, np.float64)
    opens = joined.astype(np.int64)
    for device in devices:
        if device.quantity not in {Quantity.FIXED_POINT, Quantity.AIR_VELOCITY}:  # these turn with the body
            opens[device.segment] = 1
    carries = np.zeros(skeleton.n_segments, np.int64)
    carries[[segment for segment, _ in skeleton.contacts]] = 1
    arms = [np.asarray(device.position, np.float64) - lever_arms[device.segment] for device in devices]
    return ChainBody(
        parents=parents,
        opens=opens,
        to_joint=-lever_arms,
        from_parent=np.where(joined[:, None], bridges.before - lever_arms[parents], 0.0),
        is_bridged=bridges.is_bridged,
        beyond=bridges.beyond,
        slack=bridges.slack,
        device_segment=np.array([device.segment for device in devices], np.int64),
        device_kind=np.array([int(device.quantity) for device in devices], np.int64),
        device_arm=np.array(arms, np.float64).reshape(len(devices), 3),
        carries=carries,
        gravity=np.array(suit.gravity, np.float64),
        at_rest=-np.array(suit.gravity, np.float64),
        field=np.array(suit.magnetic_field, np.float64),
        uses_field=uses_field,
    )


def fixed_points(body: ChainBody) -> IntArray:
    """(d,) 1 where a device is a fixed point."""
    fixed: IntArray = (body.device_kind == int(Quantity.FIXED_POINT)).astype(np.int64)
    return fixed
