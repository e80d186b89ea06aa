"""What the tree filter knows and keeps: the body, its state, the work space of an instant.

All of it are records (``gateway.geometry.records``): one a segment, one a device, one for what all share.
World vectors that are averages turn with every correction of their segment.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np

from gateway.body.skeleton import Interpolation, WornSuit
from gateway.frames import FloatArray, IntArray, Quantity, Status
from gateway.geometry.records import Block, Matrix, Record, Records, Six, Vector, record, records
from gateway.reconstruction.inertial.tree.tuning import Tuning, tuning

N_READINGS = 12
"""Readings of a local device that a derivative is fitted to, at most."""
PHASES = 3
"""Of joints that are asked about their lever arms."""
N_HISTORY = 96
"""Frames kept of the segment that carries a local device."""


class Started(IntEnum):
    """Whether a segment has an orientation."""

    NO = 0
    """No sample yet."""
    YES = 1
    AGAIN = 2
    """It has an orientation, but was silent for so long that it begins anew."""


class Heading(IntEnum):
    """Whether a segment's heading has been shown: against its parent, of a root in the world."""

    OBSERVED = 0
    UNOBSERVED = 1


class Validity(IntEnum):
    """What of a module's sample counts; each with all before it."""

    NOTHING = 0
    SATURATED_RATE = 1
    """The segment turns by a gyroscope at the end of its range."""
    RATE = 2
    FORCE = 3


class Clip(IntEnum):
    """Whether it is the end of the gyroscope's range that a gap comes from."""

    NONE = 0
    LASTS = 1
    LEFT = 2
    """The last sample was the first one within the range: the next shows the slope of its rate."""


class Link(Record):
    """A segment as it is built and worn; constant."""

    parent: int  # nearest one towards the root with a module; −1: none, or has none itself
    heading_observable: int  # 1: motion can show it: against the parent, or of a root by a device of its tree
    to_joint: Vector  # module to proximal joint, own axes, m
    from_parent: Vector  # parent's module to this joint, parent's axes, m
    is_bridged: int  # 1: segments without module lie between; see ``bridges_of``
    beyond: Vector  # of these, what turns with this segment, own axes, m
    slack: float  # by how much the joint beyond them may be elsewhere, m
    stands: int  # 1: made to stand on the ground
    phase: int  # joints are asked about their lever arms in turn, so that no frame has all the work


class Mount(Record):
    """Where a local device sits; constant."""

    segment: int
    kind: int  # Quantity
    arm: Vector  # module to device, segment axes, m


class World(Record):
    """What is the same for all segments; constant."""

    gravity: Vector  # m/s²
    at_rest: Vector  # specific force of what does not accelerate: −gravity
    magnetic_field: Vector  # µT
    uses_field: int
    is_tree: int  # 1: one filter over the whole tree; 0: segment by segment, outward


class Body(NamedTuple):
    """The suit as the filter sees it; constant."""

    segments: Records[Link]
    devices: Records[Mount]
    world: World


class Averages(Record):
    """What rows are made of, through their low-pass, world axes; see ``prediction.average``."""

    force: Vector  # of R f, m/s²
    last_force: Vector  # R f of the frame before
    lever_arm_matrix: Matrix  # of R [ω]×, rad/s
    force_shock: float  # by how much shocks may have moved ``force``, m/s²
    rate_shock: float  # the same of the angular rate, rad/s
    seconds: float  # since these were begun


class Velocity(Record):
    """The velocity of a module by what it feels; see ``velocity``."""

    felt: Vector  # world axes, m/s
    lasting: Vector  # mean of that over some seconds
    tilted_s: float  # for how long the tilt has been off as it is now, as far as that is in it
    variance: float  # of a component, but for that, (m/s)²
    square: float  # mean square of a horizontal component, as seen lately, (m/s)²
    waits_s: float  # since the last specific force; infinite: it begins anew with the next


class LeverArms(Record):
    """Found errors of a joint's place on both its segments, and their filter."""

    error: Six  # of to_joint, of from_parent, m
    covariance: Block
    row_variance: float  # what it meant for a component of the joint's row when asked, (m/s²)²
    since_s: float  # since then; infinite: never


class FieldWatch(Record):
    """Norm and dip of the field that a module sees."""

    norm: float  # mean, µT
    dip: float  # mean, rad
    seconds: float  # for which it has been seen
    norm_change: float  # of now
    dip_change: float
    error_square: float  # mean square of what both are wrong by
    stays: Vector  # the last one that differed from the one before it, segment axes, µT; see ``stuck``
    turned: Vector  # how the gyroscope has turned that since
    stays_s: float  # since then
    is_stuck: int  # 1: it has stayed although the module has turned


class Compass(Record):
    """By what a segment's heading in the filter seems off, as its field shows; see ``compass``."""

    angle: float  # rad
    rate: float  # by which that grows, rad/s
    misread: float  # how much of the angle a tilt's error, as it is now, makes of it: 0 to 1
    variance: float  # of angle, but for that, and rate
    covariance: float
    rate_variance: float
    scatter: float  # mean square of what a look differs by from what is expected, rad²
    tilt_square: float  # mean square of what a tilt's error makes of the angle, rad²
    offset_square: float  # and of that and what the field itself is off by throughout
    seconds: float  # for which it has been seen
    error: float  # by which the heading is taken to be off, by all compasses and the filter, rad
    error_variance: float
    settled_s: float  # of a root: for how long no heading of its chain has been shown anew
    share: float  # of a root: of what its compasses say, where the filter says the rest
    unseen_square: float  # of a root: by which all of its body may have turned unseen, lately, rad²
    unseen_turned: float  # of a root: by how much of that its compasses have turned its body back, rad


class HeadingSums(Record):
    """What motion has shown of an unobserved heading; see ``start``."""

    along: float  # Σ of cosines over variances
    across: float  # Σ of sines
    length: float  # how long both together could be
    square: float  # Σ of both sides' squares over variances
    expected: float  # what noise lets expect of square less 2 κ
    seconds: float


class ZeroRateWatch(Record):
    """Whether a segment turns and accelerates no longer."""

    rate: Vector  # mean, rad/s
    force: Vector  # mean, m/s²
    off_rate: Vector  # what the last sample was off the mean, rad/s
    off_force: Vector  # m/s²
    rate_square: float  # mean square of what the rate is off its mean, (rad/s)²
    rate_lasting: float  # mean product of what it is off in two samples in a row
    force_lasting: float  # (m/s²)²
    still_s: float  # for how long both have been small


class SunSums(Record):
    """Headings that the sun showed."""

    along: float
    across: float
    seconds: float
    has_shown: int  # 1: it has shown this segment's heading


class Vibration(Record):
    """Vibration and shocks that a sensor measures, in its unit; see ``vibration.watch_vibration``."""

    square: float  # mean, of a component
    shock: float  # by how much its last two readings may be off, each; 0: no shock
    samples: float
    last: Annotated[FloatArray, 3, 4]  # of each axis, newest first


class Corrections(Record):
    """What the filter's own corrections say; see ``prediction.note_corrections``."""

    sums: Annotated[FloatArray, 2]  # of this block, horizontal, rad
    sums_before: Annotated[FloatArray, 2]  # of the one before
    seconds: float
    product: float  # mean of the two blocks'
    square: float  # and of their squares
    gyroscope: float  # noise inflation, 0 to 1
    rows: float


class Gap(Record):
    """A time without a rate: the module is silent, or its gyroscope is at the end of its range."""

    seconds: float  # since the last rate, 0: none
    rate: Vector  # that rate, bias included, rad/s
    slope: Vector  # and its change over the step before, rad/s²; NaN: not known
    turn: Vector  # by what the segment has been turned since, segment axes, rad
    cause: int  # Clip
    clipped_axes: Matrix  # rows: axes that came to the end of their range, segment axes, or 0
    missed: float  # variance of what the gyroscope has not shown since, not in P yet, rad²
    last_slope: Vector  # of the newest rate, at the end of the range too, rad/s²; NaN: not known
    clip_s: Vector  # of each axis, since its last rate within the range; 0: it is there
    clip_left: Vector  # how many of its newest rates are within the range again; 3: more than two
    clip_rate: Vector  # that last rate about it, bias included, rad/s
    clip_slope: Vector  # and its change over the step before, rad/s²; NaN: not known
    clip_turn: Vector  # by what the segment has been turned about it since, rad
    clip_mean: Matrix  # rows: sum of where it was meanwhile times how long, segment axes as they are now, s
    made_up: float  # sum of the squares of what has been made up for since the gap began, rad²
    is_lost: int  # 1: an axis came back of which nothing could be made up for


class Segment(Record):
    """The state of a segment."""

    started: int  # Started
    heading: int  # Heading
    defined_square: float  # variance of the heading in the world that (57a) has taken for known, rad²
    silent_s: float  # since the gyroscope's last sample within its range
    gap: Gap
    R: Matrix  # segment to world
    bias: Vector  # of the gyroscope, rad/s
    force_bias: Vector  # found error of the accelerometer, m/s², where a local device is
    P: Block  # covariance of its errors: orientation (world axes, rad), bias (segment axes, rad/s)
    C: Block  # of its errors (rows) with its parent's (columns)
    published: Matrix  # covariance of its orientation's error as published, rad², world axes
    tilt_share: float  # of P of its tilt against its neighbours', as the joints around it agree
    rate: Vector  # last measured, bias included, rad/s
    rate_slope: Vector  # its change over the last step, rad/s²; NaN: not known
    bend_square: float  # mean square of the rate's second derivative lately, (rad/s³)²; NaN: not known
    averages: Averages
    velocity: Velocity
    arms: LeverArms
    joint_nis: float  # of the joint to the parent: mean of its residual's square over what is expected
    field_watch: FieldWatch
    compass: Compass
    heading_sums: HeadingSums
    sun: SunSums
    zero_rate: ZeroRateWatch
    aids_s: float  # for how much longer a foot that has stood aids its chain
    felt_square: float  # mean square acceleration of single samples, as seen lately, (m/s²)²
    vibration: Vibration  # of the specific force
    rate_vibration: Vibration  # of the angular rate
    corrections: Corrections


class Reading(Record):
    """A reading of a local device."""

    time_s: float  # since the first frame
    value: Vector  # world axes
    sigma: float


class PastFrame(Record):
    """What a device's segment felt; ``turn`` of the device brings it into the world of now."""

    time_s: float  # −inf: none
    force: Vector  # R f
    shock: float  # by how much it may be off, m/s²
    R: Matrix
    rate: Vector  # segment axes, rad/s


class Device(Record):
    """The state of a local device."""

    shift: Vector  # found error of its arm, m
    covariance: Block  # of that and of the accelerometer's error
    age_s: float  # since its last row
    fit_span_s: float  # span of its readings that a fit takes
    fit_density: float  # what the last fit left, (m/s²)² s
    n_readings: int
    is_waiting: int  # 1: the last reading waits for its frames
    readings: Annotated[Records[Reading], Reading, N_READINGS]  # oldest first
    history: Annotated[Records[PastFrame], PastFrame, N_HISTORY]  # oldest first
    turn: Matrix  # all corrections since the first of them


NEVER_NS = int(np.iinfo(np.int64).min)
"""An instant before all others: times may be negative."""


class Clock(Record):
    """The filter's times; ``NEVER_NS``: no frame yet."""

    last_ns: int
    first_ns: int


class State(NamedTuple):
    """The state of the filter; changed in place."""

    segments: Records[Segment]
    devices: Records[Device]
    clock: Clock


class Evidence(Record):
    """The rows of an instant in information form: of a segment alone (``own``), and of the edge to its
    parent, child ``c`` and parent ``p``, in their orientation errors only."""

    own: Block
    own_vector: Six
    cc: Matrix
    cp: Matrix
    pp: Matrix
    c: Vector
    p: Vector


class SegmentWork(Record):
    """The work space of a segment; nothing in it outlives an instant."""

    specific_force: Vector  # m/s², segment axes, at the module; NaN where there is none
    angular_rate: Vector  # rad/s, segment axes
    magnetic_field: Vector  # µT, segment axes
    status: int  # Status
    clipped: int  # Clipped
    clipped_axes: Matrix  # rows: axes of the gyroscope at the end of their range, segment axes, or 0
    sun: Vector  # direction, segment axes; NaN where it is not seen
    sun_sigma: float
    validity: int  # Validity
    is_felt: int  # 1: the specific force is within its range, whatever the gyroscope is
    stood_s: float  # for how long it has not accelerated, 0: it does
    mean_rate: Vector  # that turns it from the frame before to this one, rad/s
    before: Matrix  # orientation of the frame before
    tilt_before: float  # variance of a component of its tilt before the prediction, rad²
    bridged_s: float  # length of the gap that this sample ends and that can be bridged; 0: none
    bridge: Vector  # how it has turned since the last sample before that, segment axes, rad
    K: Matrix  # filtered lever-arm matrix, 1/s², world
    motion: float  # ‖[ω̇, ω]‖, 1/s²
    mean_force: Vector  # specific force over the time that a velocity has come from, m/s²
    turn: Vector  # world rotation that it is given, rad
    rotation: Matrix  # of that
    rolling: float  # rad/s²; see ``unaided.note_rolling``
    aided: int  # 1: a device or the ground shows what it accelerates by
    chain: int  # first segment of the chain that it belongs to
    lasting_tilt: float  # of a first segment: what its chain's common tilt is less certain by, rad²
    steadiest_square: float  # mean square speed of the segment that shows that, (m/s)²
    sharing: int  # of a first segment: how many of its chain have a sample
    is_before: int  # 1: turns back, since that segment is known better
    is_beyond: int  # 1: turns with the segment whose heading was shown
    is_settled: int  # 1: the sun has just shown its heading
    density: float  # of the gyroscope's noise, (rad/s)²/Hz
    information: float  # by compasses of the segment and those beyond, of its heading's error: weight, 1/rad²
    information_angle: float  # and weight times angle, 1/rad
    compass_turn: float  # what corrections have just turned its compass by, rad
    error_before: float  # by which its heading was taken to be off in the instant before, rad
    knows: float  # of its compass: how much it counts beside the surest, 0 to 1
    unwrapped: float  # rad, of the compass, so that neighbours differ by less than half a turn
    expected: float  # rad, error of the heading less that of the parent's, by motion alone
    apart: float  # and its variance, rad²
    is_first: int  # its heading has nothing to do with a parent's: it is a root, or that one is lost
    field_off: float  # heading by which the field is seen off, rad
    disturbance: float  # of the field, 1: none
    U: Vector  # specific force at the proximal joint as the segment sees it, world
    u: Vector  # and at the joint to the parent, which may lie beyond; see ``bridges_of``
    u_parent: Vector  # there as its parent sees it
    row_variance: float  # of a component of the joint's row, (m/s²)²
    evidence: Evidence
    x: Six  # the errors found
    is_known: int  # 1: the prior has been inverted
    known: Block  # prior information, of segments with children
    G: Block  # of the segment on its parent
    W: Block  # covariance given the parent
    offset: Six  # error where the parent has none
    agreement: float  # sum of N of the joints around it
    agreeing: int  # and how many they are
    least_tilt: float  # of a first segment: variance of the tilt known best in its chain, rad²


class Joint(NamedTuple):
    """A joint between two segments with modules: single records, of which no reference is counted."""

    link: Link  # of the child
    child: Segment
    parent: Segment
    now: SegmentWork  # of the child
    above: SegmentWork  # of the parent


class Learning(Record):
    """What learning lever arms works in: three rows on six constants."""

    rows: Annotated[FloatArray, 3, 6]
    gains: Annotated[FloatArray, 3, 6]  # covariance of each row with the constants, after the rows before it
    scaled: Annotated[FloatArray, 3, 6]  # over the variance of the innovation
    residual: Vector
    off: Vector  # variance that an uncertain orientation gives each row
    variance: float  # of a row but for that
    at_once: float  # of a single row, as outliers are judged by
    memory: float  # rows for which ``off`` stays
    found: Vector  # innovations
    change: Six  # of the constants


class LocalPair(Record):
    """What the two sides of a device's row are made of, world axes."""

    u: Vector  # specific force of the module, R f, averaged with the fit's kernel
    y: Vector  # that of the device, by its readings
    arm: Matrix  # what a device off the module adds to u, by its place there (segment axes, m)
    turn: Matrix  # R averaged as u is
    variance: float  # of the fit, (m/s²)²
    shock: float  # by how much shocks may have moved u, m/s²
    span_s: float  # of the readings


class ExpectedField(Record):
    """What every segment's field is compared with, and the gains of its averages."""

    norm: float  # µT
    dip: float  # rad, above the horizontal
    horizontal: float  # square of the part of it that shows a heading
    by_tilt: float  # rad², of the heading it shows, by how accelerometers tilt the module
    gain: float  # of a low-pass of ``field_memory_s``
    change_gain: float  # and of ``field_change_s``
    smoothing_gain: float  # and of ``smoothing_s``


class SharedWork(Record):
    """The work space that all segments share; nothing in it outlives an instant."""

    time_s: float  # since the first frame
    sees_sun: int
    sun: Vector  # direction in the world
    expected: ExpectedField
    force: Vector
    force_world: Vector
    lever_arm_matrix: Matrix
    reading: Vector
    rotation: Matrix
    learning: Learning
    pair: LocalPair
    A: Block  # prior regression on the parent
    B: Block
    X: Block


class Work(NamedTuple):
    """The work space of an instant, made once so that no frame has to make arrays."""

    segments: Records[SegmentWork]
    shared: SharedWork


def initial_state(n: int, d: int) -> State:
    """Return the state of n segments and d devices before their first sample."""
    state = State(records(Segment, n), records(Device, d), record(Clock))
    state.clock.last_ns = state.clock.first_ns = NEVER_NS
    state.segments["heading"] = Heading.UNOBSERVED
    state.segments["arms"]["since_s"] = np.inf
    state.devices["age_s"] = np.inf
    state.devices["history"]["time_s"] = -np.inf
    state.devices["turn"] = np.eye(3)
    return state


def work_space(n: int) -> Work:
    """Return the work space of n segments before their modules' first samples."""
    work = Work(records(SegmentWork, n), record(SharedWork))
    for name in ("specific_force", "angular_rate", "magnetic_field", "sun", "sun_sigma"):
        work.segments[name] = np.nan
    work.segments["status"] = Status.MISSING
    work.shared.sun[:] = np.nan
    return work


def chain_body(
    suit: WornSuit, uses_field: bool, is_tree: bool = True, constants: Tuning | None = None
) -> Body:
    """Return the suit as the filter sees it.

    Devices on segments without a module are left out: no acceleration is measured there to compare theirs
    with.
    """
    skeleton = suit.skeleton
    has_module = suit.module_of_segment >= 0
    bridges = bridges_of(suit, constants or tuning())
    joined = bridges.parents >= 0
    devices = [device for device in suit.local_devices if has_module[device.segment]]
    lever_arms = np.asarray(suit.lever_arms, np.float64)
    links, mounts, world = records(Link, skeleton.n_segments), records(Mount, len(devices)), record(World)
    links["parent"] = bridges.parents
    links["heading_observable"] = joined
    links["phase"] = np.arange(skeleton.n_segments) % PHASES
    for device in devices:
        if device.quantity not in {Quantity.FIXED_POINT, Quantity.AIR_VELOCITY}:  # these turn with the body
            shown = root_of(bridges.parents, device.segment) if is_tree else device.segment
            links["heading_observable"][shown] = 1
    links["to_joint"] = -lever_arms
    links["from_parent"] = np.where(joined[:, None], bridges.before - lever_arms[bridges.parents], 0.0)
    links["is_bridged"], links["beyond"], links["slack"] = bridges.is_bridged, bridges.beyond, bridges.slack
    links["stands"][[segment for segment, _ in skeleton.contacts]] = 1
    for d, device in enumerate(devices):
        mounts["segment"][d], mounts["kind"][d] = device.segment, int(device.quantity)
        mounts["arm"][d] = np.asarray(device.position, np.float64) - lever_arms[device.segment]
    world.gravity[:], world.at_rest[:] = suit.gravity, -np.array(suit.gravity, np.float64)
    world.magnetic_field[:] = suit.magnetic_field
    world.uses_field, world.is_tree = int(uses_field), int(is_tree)
    return Body(links, mounts, world)


def root_of(parents: IntArray, s: int) -> int:
    """Return the root of the tree that segment s is in. parents: (n,), −1 of a root."""
    while parents[s] >= 0:
        s = int(parents[s])
    return s


# The body: chains go on over segments without module
#
# Where two modules see the joint between them, others may lie between that have none, like the spine between
# pelvis and thorax. The body's rules say how those turn: by a share φ of the bend between two segments. To
# first order their lengths ``o`` then split, ``R o ≈ (1 − φ) R_a o + φ R_s o``: one part turns with either
# end, and there is one joint between the two again, as if nothing else lay there. In truth the bend may
# happen anywhere on the way: where that joint is remains uncertain by half the way.


class Bridges(NamedTuple):
    """How segments without a module are bridged; arrays by segment."""

    parents: IntArray  # (n,) nearest one towards the root with a module; −1: none, or has none itself
    before: FloatArray  # (n, 3) that one's proximal joint to the joint between, its axes, m
    beyond: FloatArray  # (n, 3) the joint between to the own proximal joint, own axes, m
    slack: FloatArray  # (n,) standard deviation of where that joint is, m
    is_bridged: IntArray  # (n,) 1 where segments lie between


def bridges_of(suit: WornSuit, tuning: Tuning) -> Bridges:
    """Return the bridges over segments without a module, by segment.

    A segment without a module is in no chain.
    """
    skeleton, n = suit.skeleton, suit.skeleton.n_segments
    rules = {rule.segment: rule for rule in skeleton.interpolations}
    parents, is_bridged = np.full(n, -1, np.int64), np.zeros(n, np.int64)
    before, beyond, slack = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
    for s in np.flatnonzero(suit.module_of_segment >= 0):
        between = _without_module(suit, int(s))
        a = int(skeleton.parents[between[-1] if between else s])
        if a < 0:
            continue
        parents[s], is_bridged[s] = a, int(bool(between))
        before[s] = skeleton.offsets[between[-1] if between else s]
        for child, segment in zip([int(s), *between], between, strict=False):
            length, rule = skeleton.offsets[child], rules.get(segment)
            share = _share(rule, a, int(s))
            before[s] += (1.0 - share) * length
            beyond[s] += share * length
            bends = tuning.joint_slack if share == 0.0 else 0.5 * tuning.joint_slack
            slack[s] += bends * float(np.linalg.norm(length))
    return Bridges(parents, before, beyond, slack, is_bridged)


def _without_module(suit: WornSuit, s: int) -> list[int]:
    """Return the segments between s and the nearest with a module, from s towards the root."""
    between, p = [], int(suit.skeleton.parents[s])
    while p >= 0 and suit.module_of_segment[p] < 0:
        between.append(p)
        p = int(suit.skeleton.parents[p])
    return between


def _share(rule: Interpolation | None, a: int, s: int) -> float:
    """Return the share of the bend from a to s by which a segment between them turns.

    Without a rule for these two it is 0: the segment turns as a does.
    """
    return rule.fraction if rule is not None and (rule.first, rule.second) == (a, s) else 0.0
