"""Which segments stand still, and where the body is: it stands on what rests, and flies on what its modules
feel. Compiled.

Standing is found by SHOE, the generalised likelihood ratio test of Skog, Händel, Nilsson & Rantakokko (IEEE
Trans. Biomed. Eng. 57, 2010), eq. 15: at rest the specific force is gravity of whatever direction and the
rate is zero,

    T = mean over a window of ‖f − g f̄/‖f̄‖‖²/σ_f² + ‖ω‖²/σ_ω²,

which is ``(E‖f‖² − 2 g ‖E f‖ + g²)/σ_f² + E‖ω‖²/σ_ω²``, as the mean of ``f · f̄`` is ``‖f̄‖²``: variance and
magnitude of the specific force in one number. Rest begins below a low threshold and ends above a higher one.
The window is short and ends abruptly: a running foot is flat on the ground for 0.1 s after a swing of 10
rad/s.

The place is a Kalman filter per world axis over the module of the skeleton's root: position, velocity, and
the error of the acceleration (tilt error leaks gravity into it). Predicted by the module's own acceleration
``R f + g``; while a contact segment rests, the point it stands on has no velocity (zero-velocity update,
Foxlin 2005, with the legs' kinematics between) and stays where it was. Feet take over from each other without
a step, as each is held where the filter has it. On a level floor the height is not held but measured: what
rests is on the floor. All axes but the vertical share one covariance.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Matrix, Record, Records, Vector, records
from gateway.geometry.vectors import dot, is_finite, norm
from gateway.reconstruction.inertial.observations import SegmentObservations

# Standing


WINDOW_S = 0.045
"""Skog et al. took 5 samples at 100 Hz."""
N_HISTORY = 24
"""Frames of a window at most."""
FORCE_SIGMA = 1.0
"""m/s²: a shoe gives, and sensors are off by a few tenths."""
RATE_SIGMA = 0.5
"""rad/s: a foot rolls a little while it stands."""
BEGINS_BELOW, ENDS_ABOVE = 4.0, 12.0
"""T at which rest begins, and ends."""
SLOW_SEGMENT_S = 0.7
"""Segments that are not made to stand on must be still for so long: they also move slowly."""


class PastFrame(Record):
    """A sample of a segment's module."""

    age_s: float  # infinite: nothing
    force: Vector  # specific force, m/s²
    rate_square: float  # (rad/s)²


class Stance(Record):
    """How long a segment has stood still, and the samples that this is judged by."""

    still_s: float  # since the test is passed
    frames: Annotated[Records[PastFrame], PastFrame, N_HISTORY]  # newest first


class StanceState(NamedTuple):
    """Changed in place."""

    segments: Records[Stance]


def initial_stance(n: int) -> StanceState:
    """Return the state of n segments before the first frame: none stands still."""
    segments = records(Stance, n)
    segments["frames"]["age_s"] = np.inf
    return StanceState(segments)


@compiled
def watch_stance(
    stood_s: FloatArray,
    state: StanceState,
    carries: FloatArray,
    gravity: float,
    observed: SegmentObservations,
    dt: float,
) -> None:
    """Set stood_s (n,) to how long each segment has been at rest, s; 0: it is not, or its module is silent.

    carries: (n,) 1 for segments that stand on the ground (feet). gravity: its size, m/s². dt: since the frame
    before, s.
    """
    force, rate, status = observed.specific_force, observed.angular_rate, observed.status
    for s in range(len(carries)):
        segment = state.segments[s]
        stood_s[s] = 0.0
        # a module that is silent, or repeats itself, shows nothing
        if status[s] > 1 or not (is_finite(force[s]) and is_finite(rate[s])):
            for k in range(N_HISTORY):
                segment.frames[k].age_s = np.inf
            segment.still_s = 0.0
            continue
        _remember(segment.frames, force[s], rate[s], dt)
        limit = ENDS_ABOVE if segment.still_s > 0.0 else BEGINS_BELOW
        is_still = _test(segment.frames, gravity) < limit
        segment.still_s = segment.still_s + dt if is_still else 0.0
        if carries[s] > 0.0 or segment.still_s > SLOW_SEGMENT_S:
            stood_s[s] = segment.still_s


@compiled
def _remember(frames: Records[PastFrame], force: FloatArray, rate: FloatArray, dt: float) -> None:
    """Put a frame before the others, the oldest of which is forgotten."""
    for k in range(N_HISTORY - 1, 0, -1):
        frames[k] = frames[k - 1]
        frames[k].age_s += dt
    newest = frames[0]
    newest.age_s, newest.rate_square = 0.0, dot(rate, rate)
    for i in range(3):
        newest.force[i] = force[i]


@compiled
def _test(frames: Records[PastFrame], gravity: float) -> float:
    """Return T of the frames within the window, equation (37) of the estimator.

    It is infinite while they do not fill half of it.
    """
    x, y, z = 0.0, 0.0, 0.0
    square, rate, count, oldest = 0.0, 0.0, 0, 0.0
    for k in range(N_HISTORY):
        frame = frames[k]
        if frame.age_s > WINDOW_S:
            break
        f, g, h = frame.force[0], frame.force[1], frame.force[2]
        x, y, z = x + f, y + g, z + h
        square += f * f + g * g + h * h
        rate += frame.rate_square
        oldest = frame.age_s
        count += 1
    if oldest < 0.4 * WINDOW_S and count < N_HISTORY:
        return np.inf
    spread = (square - 2.0 * gravity * math.sqrt(x * x + y * y + z * z)) / count + gravity**2
    return spread / FORCE_SIGMA**2 + rate / count / RATE_SIGMA**2


# Where the body is


ACCELERATION_NOISE = 0.1
"""m/s²/√Hz."""
ACCELERATION_ERROR = 0.3
"""m/s²: of the acceleration as it lasts: 2° of tilt."""
ERROR_MEMORY_S = 2.0
BLIND_ACCELERATION = 5.0
"""m/s²/√Hz while the root's module is silent."""
CONTACT_SPEED = 0.03
"""m/s: of the point a foot stands on, by the legs' kinematics."""
CONTACT_PLACE = 0.01
"""m."""
CORRELATION_S = 0.05
"""For how long a contact's error lasts: denser frames carry no more information in all."""
SETTLING_S = 0.03
"""A foot that has been at rest for so long is held where it is."""
SLIP_SPEED = 0.1
"""m/s: a point that the legs see move faster has left the ground, whatever the foot's module shows; and
the ball of a foot that rolls off its heel stays until then."""
SURELY = 3.0
"""Standard deviations of the body's velocity beyond which a contact that slips is not one."""
RELAXATION_S = 2.0
"""Two feet that are held share out what they contradict each other."""
PUSH_OFF_S = 0.3
"""A foot counts as what the body stands on for so long after it began to roll."""
LONGEST_FLIGHT_S = 1.5
"""No jump lasts longer: then the feet's modules are silent or stuck, and the body stays in place."""
HALT_S = 0.5
"""Time constant with which it halts then, and comes back to the floor."""


class ContactPlace(Record):
    """A point that a segment stands on; constant."""

    segment: int
    point: Vector  # from the segment's proximal joint, own axes, m


class Walk(Record):
    """What is followed, and on what it walks; constant."""

    reference: int  # segment whose module the filter follows
    has_floor: int
    floor: float  # m
    arm: Vector  # from that segment's proximal joint to the module, own axes, m
    gravity: Vector  # m/s²


class Contact(Record):
    """The state of a contact."""

    anchor: Vector  # where it is held, m; NaN: it is not
    rolling_s: float  # since its segment last rested
    has_slipped: int  # 1: moves against what carries the body, whatever its module shows


class Position(Record):
    """The position of the body and its covariance."""

    x: Matrix  # by world axis: position of the root's module m, velocity m/s, error m/s²
    P: Annotated[FloatArray, 2, 3, 3]  # horizontal, vertical
    acceleration: Vector  # of the frame before, world, m/s²
    has_begun: int
    aloft_s: float  # since anything rested
    standing: int  # contact segment that the body stands on, −1: none


class PositionState(NamedTuple):
    """Changed in place."""

    body: Records[Position]  # one
    contacts: Records[Contact]


class Walker(NamedTuple):
    """What carries the body, and where it is."""

    parents: IntArray  # (n,) of the skeleton
    offsets: FloatArray  # (n, 3)
    places: Records[ContactPlace]
    walk: Walk
    body: Position
    contacts: Records[Contact]


class Moving(NamedTuple):
    """A point, and room to turn a vector in."""

    place: FloatArray  # (3,) m
    velocity: FloatArray  # (3,) m/s
    turned: FloatArray  # (3,)


def initial_position(n_contacts: int) -> PositionState:
    """Return the state before the body has a position."""
    state = PositionState(records(Position, 1), records(Contact, n_contacts))
    state.body["standing"], state.contacts["anchor"] = -1, np.nan
    return state


@compiled
def advance_position(
    walker: Walker,
    q_wb: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    stood_s: FloatArray,
    dt: float,
) -> tuple[FloatArray, int]:
    """Advance by one frame; return the root joint's position (3,), m, and the segment stood on.

    q_wb: (n, 4). rate: (n, 3) rad/s, segment axes. force: (n, 3) m/s², segment axes; NaN: none. stood_s: (n,)
    s. dt: s. The segment is −1 if the body stands on none. The position is NaN until the reference segment
    and a contact have orientations.
    """
    r, v_r = _relative_motion(walker, q_wb, rate)
    walk, body, contacts, ref = walker.walk, walker.body, walker.contacts, walker.walk.reference
    if not is_finite(q_wb[ref]):
        return np.full(3, np.nan), -1
    to_root = -quaternion.rotate(q_wb[ref], walk.arm) - _joint_of(walker, q_wb, ref)
    if not body.has_begun and not _begin(walk, body, r, to_root):
        return np.full(3, np.nan), -1

    acceleration = quaternion.rotate(q_wb[ref], force[ref]) + walk.gravity
    if body.aloft_s > LONGEST_FLIGHT_S:
        acceleration[:] = np.nan
        _halt(walk, body, r, dt)
    _predict(body, acceleration, dt)

    # zero velocity of what stands; a contact that is lost is no longer held where it was
    n_held = 0
    for c in range(len(contacts)):
        stands_s = stood_s[walker.places[c].segment]
        if _holds(walker, c, stands_s, r[c], v_r[c], dt):
            n_held += 1
            _stand(walker, c, stands_s, r[c], v_r[c], dt)
        else:
            for i in range(3):
                contacts[c].anchor[i] = np.nan

    # contacts that are held together move towards where the filter has them
    if n_held > 1:
        for c in range(len(contacts)):
            anchor = contacts[c].anchor
            if is_finite(anchor):
                gap = body.x[:, 0] + r[c] - anchor
                anchor += gap * min(1.0, dt / RELAXATION_S)

    if walk.has_floor:
        _stand_on_floor(walker, stood_s, r, dt)
    _choose(walker, stood_s, dt)
    return body.x[:, 0] + to_root, body.standing


@compiled
def _relative_motion(walker: Walker, q_wb: FloatArray, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return position (c, 3), m, and velocity (c, 3), m/s, of the contacts in the world.

    Both are relative to the reference module.
    """
    n, walk = len(walker.parents), walker.walk
    p, v, turned = np.zeros((n, 3)), np.zeros((n, 3)), np.empty(3)
    for s in range(n):
        u = walker.parents[s]
        if u >= 0:
            joint = Moving(p[u], v[u], turned)
            _carry(Moving(p[s], v[s], turned), joint, q_wb[u], rate[u], walker.offsets[s])

    ref, here, moves = walk.reference, np.empty(3), np.empty(3)
    joint = Moving(p[ref], v[ref], turned)
    _carry(Moving(here, moves, turned), joint, q_wb[ref], rate[ref], walk.arm)
    m = len(walker.places)
    r, v_r = np.empty((m, 3)), np.empty((m, 3))
    for c in range(m):
        s = walker.places[c].segment
        joint = Moving(p[s], v[s], turned)
        _carry(Moving(r[c], v_r[c], turned), joint, q_wb[s], rate[s], walker.places[c].point)
        for i in range(3):
            r[c, i] -= here[i]
            v_r[c, i] -= moves[i]
    return r, v_r


@compiled
def _carry(to: Moving, joint: Moving, q: FloatArray, rate: FloatArray, arm: FloatArray) -> None:
    """Set ``to`` to the point ``arm`` (3,) from a moving joint, on a segment that turns.

    rate and arm are in the segment's axes.
    """
    turned = to.turned
    quaternion.rotate_into(turned, q, arm)
    for i in range(3):
        to.place[i] = joint.place[i] + turned[i]
    swept = (
        rate[1] * arm[2] - rate[2] * arm[1],
        rate[2] * arm[0] - rate[0] * arm[2],
        rate[0] * arm[1] - rate[1] * arm[0],
    )
    quaternion.rotate_into(turned, q, swept)
    for i in range(3):
        to.velocity[i] = joint.velocity[i] + turned[i]


@compiled
def _joint_of(walker: Walker, q_wb: FloatArray, segment: int) -> FloatArray:
    """Return the proximal joint of a segment from the skeleton root's joint, (3,) world, m."""
    place, turned = np.zeros(3), np.empty(3)
    s = segment
    while walker.parents[s] >= 0:
        quaternion.rotate_into(turned, q_wb[walker.parents[s]], walker.offsets[s])
        for i in range(3):
            place[i] += turned[i]
        s = walker.parents[s]
    return place


@compiled
def _begin(walk: Walk, body: Position, r: FloatArray, to_root: FloatArray) -> bool:
    """Place the body over the origin with its lowest contact on the floor.

    Returns whether a contact is known.
    """
    lowest = np.inf
    for c in range(len(r)):
        if is_finite(r[c]):
            lowest = min(lowest, r[c, 2])
    if not math.isfinite(lowest):
        return False
    body.x[:] = 0.0
    body.x[:2, 0] = -to_root[:2]
    body.x[2, 0] = walk.floor - lowest
    for k in range(2):
        body.P[k] = 0.0
        body.P[k, 1, 1], body.P[k, 2, 2] = 1.0, 0.1
    body.acceleration[:] = 0.0
    body.has_begun = 1
    return True


@compiled
def _predict(body: Position, acceleration: FloatArray, dt: float) -> None:
    """Predict position, velocity and acceleration error over dt (s).

    The mean of the last two accelerations counts. acceleration: (3,) of the reference module, world, m/s²;
    NaN: not known, and the velocity stays.
    """
    noise = ACCELERATION_NOISE
    if is_finite(acceleration):
        a = 0.5 * (acceleration + body.acceleration)
        body.acceleration[:] = acceleration
    else:
        noise = BLIND_ACCELERATION
        body.acceleration[:] = 0.0
        a = body.x[:, 2].copy()
    keep = math.exp(-dt / ERROR_MEMORY_S)
    for axis in range(3):
        x = body.x[axis]
        gained = (a[axis] - x[2]) * dt
        x[0] += (x[1] + 0.5 * gained) * dt
        x[1] += gained
        x[2] *= keep
    F = np.array([[1.0, dt, -0.5 * dt * dt], [0.0, 1.0, -dt], [0.0, 0.0, keep]])
    for k in range(2):
        P = F @ body.P[k] @ F.T
        P[1, 1] += noise**2 * dt
        P[2, 2] += ACCELERATION_ERROR**2 * (1.0 - keep**2)
        body.P[k] = P


@compiled
def _halt(walk: Walk, body: Position, r: FloatArray, dt: float) -> None:
    """Slow the body down and draw it to the floor: no contact has been seen for longer than a jump lasts.

    Accelerations integrated twice are metres off within seconds.
    """
    keep, lowest = math.exp(-dt / HALT_S), np.inf
    for c in range(len(r)):
        if is_finite(r[c]):
            lowest = min(lowest, body.x[2, 0] + r[c, 2])
    for axis in range(3):
        body.x[axis, 1] *= keep
    if walk.has_floor and math.isfinite(lowest):
        body.x[2, 0] += (walk.floor - lowest) * (1.0 - keep)


@compiled
def _holds(walker: Walker, c: int, stands_s: float, r: FloatArray, v_r: FloatArray, dt: float) -> bool:
    """Return whether contact c is on the ground and does not move.

    One that slips while another segment stands, or faster than the body's own velocity can be wrong, is not
    taken back until it moves with the body or its module has seen it move: a module that is stuck in rest
    would otherwise pull the body along.
    """
    contact, body = walker.contacts[c], walker.body
    contact.rolling_s = 0.0 if stands_s > 0.0 else contact.rolling_s + dt
    if not (is_finite(r) and is_finite(v_r)):
        return False
    speed = norm(body.x[:, 1] + v_r)
    slips = speed >= SLIP_SPEED
    is_sure = _stands_elsewhere(walker, c) or speed >= SURELY * math.sqrt(body.P[0, 1, 1])
    if stands_s == 0.0 or not slips:
        contact.has_slipped = 0
    if not is_finite(contact.anchor):
        return stands_s > 0.0 and not (contact.has_slipped > 0 and is_sure)
    if slips and stands_s > 0.0 and is_sure:
        contact.has_slipped = 1
    return bool(not slips and contact.rolling_s < PUSH_OFF_S)


@compiled
def _stands_elsewhere(walker: Walker, c: int) -> bool:
    """Return whether a contact of another segment than that of contact c is held."""
    places, contacts = walker.places, walker.contacts
    for other in range(len(places)):
        if places[other].segment != places[c].segment and is_finite(contacts[other].anchor):
            return True
    return False


@compiled
def _stand(walker: Walker, c: int, stands_s: float, r: FloatArray, v_r: FloatArray, dt: float) -> None:
    """Observe that contact c has no velocity and, once it has settled, that it stays where it is.

    Its height is left to a level floor, if there is one: a body that is held at a height it has got wrong
    climbs with every step.

    r, v_r: (3,) position and velocity relative to the reference module, world.
    """
    walk, body, anchor = walker.walk, walker.body, walker.contacts[c].anchor
    scale = max(1.0, CORRELATION_S / dt)
    for k in range(2):
        _observe(body, k, 1, -v_r, CONTACT_SPEED**2 * scale)
    n_held = 1 if walk.has_floor else 2
    if not is_finite(anchor):
        if stands_s < SETTLING_S:
            return
        anchor[:] = body.x[:, 0] + r
        for k in range(n_held):  # from here on place means place relative to what is held
            for i in range(3):
                body.P[k, 0, i], body.P[k, i, 0] = 0.0, 0.0
    for k in range(n_held):
        _observe(body, k, 0, anchor - r, CONTACT_PLACE**2 * scale)


@compiled
def _stand_on_floor(walker: Walker, stood_s: FloatArray, r: FloatArray, dt: float) -> None:
    """Observe that the lowest contact of all segments at rest is on the level floor.

    So it is even where the legs see it move, as legs of wrong lengths do. r: (c, 3) m, relative to the
    reference module, world.
    """
    lowest, value = np.inf, np.zeros(3)
    for c in range(len(walker.places)):
        if stood_s[walker.places[c].segment] >= SETTLING_S and is_finite(r[c]):
            lowest = min(lowest, r[c, 2])
    if math.isfinite(lowest):
        value[2] = walker.walk.floor - lowest
        _observe(walker.body, 1, 0, value, CONTACT_PLACE**2 * max(1.0, CORRELATION_S / dt))


@compiled
def _observe(body: Position, k: int, what: int, value: FloatArray, variance: float) -> None:
    """Update the filter's horizontal (k 0) or vertical (1) axes by a position or velocity.

    It is that of the reference module, what 0: position, m; 1: velocity, m/s. value: (3,), world.
    """
    P, x = body.P[k], body.x
    row, total = (P[what, 0], P[what, 1], P[what, 2]), P[what, what] + variance
    gain = row[0] / total, row[1] / total, row[2] / total
    for i in range(3):
        for j in range(3):
            P[i, j] -= gain[i] * row[j]
    for axis in range(2 * k, 2 + k):
        innovation = value[axis] - x[axis, what]
        for i in range(3):
            x[axis, i] += gain[i] * innovation


@compiled
def _choose(walker: Walker, stood_s: FloatArray, dt: float) -> None:
    """Choose the segment that the body stands on.

    It is the same as before while that rests, else the one that rests longest. When none rests, the last one
    stays for ``PUSH_OFF_S``.
    """
    body = walker.body
    body.aloft_s += dt
    longest, chosen = 0.0, -1
    for c in range(len(walker.places)):
        s = walker.places[c].segment
        if stood_s[s] > longest:
            longest, chosen = stood_s[s], s
    standing = body.standing
    if standing >= 0 and stood_s[standing] > 0.0:
        chosen = standing
    if chosen >= 0:
        body.standing, body.aloft_s = chosen, 0.0
    elif body.aloft_s > PUSH_OFF_S:
        body.standing = -1
