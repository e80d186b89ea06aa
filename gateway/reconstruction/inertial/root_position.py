"""Where the body is: it stands on what rests, and flies on what its modules feel. Compiled.

A Kalman filter per world axis over the module of the skeleton's root: position, velocity, and the error of
the acceleration (tilt error leaks gravity into it). Predicted by the module's own acceleration ``R f + g``;
while a contact segment rests, the point it stands on has no velocity (zero-velocity update, Foxlin 2005,
with the legs' kinematics between) and stays where it was. Feet take over from each other without a step, as
each is held where the filter has it. All axes but the vertical share one covariance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite, norm


class PositionSettings(NamedTuple):
    """One set for all bodies and gaits."""

    acceleration_noise: float = 0.1
    """m/s²/√Hz."""
    acceleration_error: float = 0.3
    """m/s²: of the acceleration as it lasts: 2° of tilt."""
    error_memory_s: float = 2.0
    blind_acceleration: float = 5.0
    """m/s²/√Hz while the root's module is silent."""
    contact_speed: float = 0.03
    """m/s: of the point a foot stands on, as the legs tell it."""
    contact_place: float = 0.01
    """m."""
    correlation_s: float = 0.05
    """For how long a contact's error lasts: denser frames say no more in all."""
    settling_s: float = 0.03
    """A foot that has been at rest for so long is held where it is."""
    slip_speed: float = 0.1
    """m/s: a point that the legs see move faster has left the ground, whatever the foot's module says; and
    the ball of a foot that rolls off its heel stays until then."""
    surely: float = 3.0
    """Standard deviations of the body's velocity beyond which a contact that slips is not one."""
    relaxation_s: float = 2.0
    """Two feet that are held share out what they contradict each other."""
    push_off_s: float = 0.3
    """A foot counts as what the body stands on for so long after it began to roll."""
    longest_flight_s: float = 1.5
    """No jump lasts longer: then the feet tell nothing (silent, stuck), and the body stays in place."""
    halt_s: float = 0.5
    """Time constant with which it halts then, and comes back to the floor."""
    floor_s: float = 0.05
    """Time constant with which a contact is drawn to the floor: a running foot is on it for 0.1 s."""


class PositionState(NamedTuple):
    """Changed in place."""

    x: FloatArray  # (3, 3) by world axis: position of the root's module m, velocity m/s, error m/s²
    P: FloatArray  # (2, 3, 3) horizontal, vertical
    acceleration: FloatArray  # (3,) of the frame before, world, m/s²
    anchor: FloatArray  # (c, 3) where a contact is held, m; NaN: it is not
    rolling_s: FloatArray  # (c,) since its segment last rested
    has_slipped: FloatArray  # (c,) 1: moves against what carries the body, whatever its module says
    clock: FloatArray  # (2,) 1 once begun; seconds since anything rested
    standing: IntArray  # (1,) contact segment that the body stands on, −1: none


class Contacts(NamedTuple):
    """What carries the body, and the reference point. Constant."""

    parents: IntArray  # (n,)
    offsets: FloatArray  # (n, 3)
    segments: IntArray  # (c,)
    points: FloatArray  # (c, 3) from the segment's proximal joint, own axes, m
    reference: int
    """Segment whose module the filter follows."""
    arm: FloatArray  # (3,) from its proximal joint to the module, own axes, m
    gravity: FloatArray  # (3,) m/s²
    has_floor: bool
    floor: float
    """m."""


def initial_position(n_contacts: int) -> PositionState:
    """Not yet begun."""
    return PositionState(
        np.zeros((3, 3)),
        np.zeros((2, 3, 3)),
        np.zeros(3),
        np.full((n_contacts, 3), np.nan),
        np.zeros(n_contacts),
        np.zeros(n_contacts),
        np.zeros(2),
        np.full(1, -1, np.int64),
    )


@compiled
def advance_position(
    contacts: Contacts,
    settings: PositionSettings,
    state: PositionState,
    q_wb: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    resting: FloatArray,
    dt: float,
) -> tuple[FloatArray, int]:
    """One frame: where the skeleton root's joint is, (3,) m, and the segment it stands on, −1 for none.

    q_wb: (n, 4). rate: (n, 3) rad/s, segment axes. force: (n, 3) m/s², segment axes; NaN: none. resting:
    (n,) s. The result is NaN until the reference segment and a contact have orientations.
    """
    r, v_r = _relative_motion(contacts, q_wb, rate)
    ref = contacts.reference
    if not is_finite(q_wb[ref]):
        return np.full(3, np.nan), -1
    to_root = -quaternion.rotate(q_wb[ref], contacts.arm) - _joint_of(contacts, q_wb, ref)
    if state.clock[0] == 0.0 and not _begin(contacts, state, r, to_root):
        return np.full(3, np.nan), -1
    acceleration = quaternion.rotate(q_wb[ref], force[ref]) + contacts.gravity
    if state.clock[1] > settings.longest_flight_s:
        acceleration[:] = np.nan
        _halt(contacts, settings, state, r, dt)
    _predict(contacts, settings, state, acceleration, dt)
    n_held = 0
    for c in range(len(contacts.segments)):
        resting_s = resting[contacts.segments[c]]
        if _holds(contacts, settings, state, c, resting_s, r[c], v_r[c], dt):
            n_held += 1
            _stand(contacts, settings, state, c, r[c], v_r[c], resting_s, dt)
        else:
            for i in range(3):
                state.anchor[c, i] = np.nan
    if n_held > 1:
        for c in range(len(contacts.segments)):
            if is_finite(state.anchor[c]):
                gap = state.x[:, 0] + r[c] - state.anchor[c]
                state.anchor[c] += gap * min(1.0, dt / settings.relaxation_s)
    _choose(contacts, settings, state, resting, dt)
    return state.x[:, 0] + to_root, state.standing[0]


@compiled
def _relative_motion(contacts: Contacts, q_wb: FloatArray, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Place (c, 3) and velocity (c, 3) of the contact points relative to the reference module; world."""
    n = len(contacts.parents)
    p, v, turned = np.zeros((n, 3)), np.zeros((n, 3)), np.empty(3)
    for s in range(n):
        parent = contacts.parents[s]
        if parent >= 0:
            _carry(p[s], v[s], p[parent], v[parent], q_wb[parent], rate[parent], contacts.offsets[s], turned)
    ref, here, moves = contacts.reference, np.empty(3), np.empty(3)
    _carry(here, moves, p[ref], v[ref], q_wb[ref], rate[ref], contacts.arm, turned)
    m = len(contacts.segments)
    r, v_r = np.empty((m, 3)), np.empty((m, 3))
    for c in range(m):
        s = contacts.segments[c]
        _carry(r[c], v_r[c], p[s], v[s], q_wb[s], rate[s], contacts.points[c], turned)
        for i in range(3):
            r[c, i] -= here[i]
            v_r[c, i] -= moves[i]
    return r, v_r


@compiled
def _carry(
    place: FloatArray,
    velocity: FloatArray,
    p: FloatArray,
    v: FloatArray,
    q: FloatArray,
    rate: FloatArray,
    arm: FloatArray,
    turned: FloatArray,
) -> None:
    """place, velocity (3,) ← of the point ``arm`` from the joint at p, which moves with v; turned: (3,) to
    work in."""
    quaternion.rotate_into(turned, q, arm)
    for i in range(3):
        place[i] = p[i] + turned[i]
    swept = (
        rate[1] * arm[2] - rate[2] * arm[1],
        rate[2] * arm[0] - rate[0] * arm[2],
        rate[0] * arm[1] - rate[1] * arm[0],
    )
    quaternion.rotate_into(turned, q, swept)
    for i in range(3):
        velocity[i] = v[i] + turned[i]


@compiled
def _joint_of(contacts: Contacts, q_wb: FloatArray, segment: int) -> FloatArray:
    """Proximal joint of a segment from the skeleton root's joint, world, m."""
    place, turned = np.zeros(3), np.empty(3)
    s = segment
    while contacts.parents[s] >= 0:
        quaternion.rotate_into(turned, q_wb[contacts.parents[s]], contacts.offsets[s])
        for i in range(3):
            place[i] += turned[i]
        s = contacts.parents[s]
    return place


@compiled
def _begin(contacts: Contacts, state: PositionState, r: FloatArray, to_root: FloatArray) -> bool:
    """Over the origin, the lowest contact on the floor."""
    lowest = np.inf
    for c in range(len(r)):
        if is_finite(r[c]):
            lowest = min(lowest, r[c, 2])
    if not math.isfinite(lowest):
        return False
    state.x[:] = 0.0
    state.x[:2, 0] = -to_root[:2]
    state.x[2, 0] = contacts.floor - lowest
    for k in range(2):
        state.P[k] = 0.0
        state.P[k, 1, 1], state.P[k, 2, 2] = 1.0, 0.1
    state.acceleration[:] = 0.0
    state.clock[0] = 1.0
    return True


@compiled
def _predict(
    contacts: Contacts, settings: PositionSettings, state: PositionState, acceleration: FloatArray, dt: float
) -> None:
    """Over dt by the mean of the last two accelerations."""
    noise = settings.acceleration_noise
    if is_finite(acceleration):
        a = 0.5 * (acceleration + state.acceleration)
        state.acceleration[:] = acceleration
    else:
        noise = settings.blind_acceleration
        state.acceleration[:] = 0.0
        a = state.x[:, 2].copy()
    keep = math.exp(-dt / settings.error_memory_s)
    for axis in range(3):
        x = state.x[axis]
        gained = (a[axis] - x[2]) * dt
        x[0] += (x[1] + 0.5 * gained) * dt
        x[1] += gained
        x[2] *= keep
    F = np.array([[1.0, dt, -0.5 * dt * dt], [0.0, 1.0, -dt], [0.0, 0.0, keep]])
    for k in range(2):
        P = F @ state.P[k] @ F.T
        P[1, 1] += noise**2 * dt
        P[2, 2] += settings.acceleration_error**2 * (1.0 - keep**2)
        state.P[k] = P


@compiled
def _halt(
    contacts: Contacts, settings: PositionSettings, state: PositionState, r: FloatArray, dt: float
) -> None:
    """Accelerations summed up twice are metres off within seconds: without a contact they count no longer."""
    keep, lowest = math.exp(-dt / settings.halt_s), np.inf
    for c in range(len(r)):
        if is_finite(r[c]):
            lowest = min(lowest, state.x[2, 0] + r[c, 2])
    for axis in range(3):
        state.x[axis, 1] *= keep
    if contacts.has_floor and math.isfinite(lowest):
        state.x[2, 0] += (contacts.floor - lowest) * (1.0 - keep)


@compiled
def _holds(
    contacts: Contacts,
    settings: PositionSettings,
    state: PositionState,
    c: int,
    resting_s: float,
    r: FloatArray,
    v_r: FloatArray,
    dt: float,
) -> bool:
    """Whether contact c is on the ground and does not move.

    One that slips while another segment stands, or faster than the body's own velocity can be wrong, is not
    taken back until it moves with the body or its module has seen it move: a module that is stuck in rest
    would else pull the body along.
    """
    state.rolling_s[c] = 0.0 if resting_s > 0.0 else state.rolling_s[c] + dt
    if not (is_finite(r) and is_finite(v_r)):
        return False
    speed = norm(state.x[:, 1] + v_r)
    slips = speed >= settings.slip_speed
    is_sure = _stands_elsewhere(contacts, state, c) or speed >= settings.surely * math.sqrt(state.P[0, 1, 1])
    if resting_s == 0.0 or not slips:
        state.has_slipped[c] = 0.0
    if not is_finite(state.anchor[c]):
        return resting_s > 0.0 and not (state.has_slipped[c] > 0.0 and is_sure)
    if slips and resting_s > 0.0 and is_sure:
        state.has_slipped[c] = 1.0
    return not slips and state.rolling_s[c] < settings.push_off_s


@compiled
def _stands_elsewhere(contacts: Contacts, state: PositionState, c: int) -> bool:
    """Whether a contact of another segment than that of contact c is held."""
    for other in range(len(contacts.segments)):
        if contacts.segments[other] != contacts.segments[c] and is_finite(state.anchor[other]):
            return True
    return False


@compiled
def _stand(
    contacts: Contacts,
    settings: PositionSettings,
    state: PositionState,
    c: int,
    r: FloatArray,
    v_r: FloatArray,
    resting_s: float,
    dt: float,
) -> None:
    """Contact c has no velocity; once it has settled it stays where it is."""
    scale = max(1.0, settings.correlation_s / dt)
    _observe(state, 1, -v_r, settings.contact_speed**2 * scale)
    if not is_finite(state.anchor[c]):
        if resting_s < settings.settling_s:
            return
        state.anchor[c] = state.x[:, 0] + r
        for k in range(2):  # from here on place means place relative to what is held
            for i in range(3):
                state.P[k, 0, i], state.P[k, i, 0] = 0.0, 0.0
    if contacts.has_floor:
        above = state.anchor[c, 2] - contacts.floor
        state.anchor[c, 2] -= above * (1.0 - math.exp(-dt / settings.floor_s))
    _observe(state, 0, state.anchor[c] - r, settings.contact_place**2 * scale)


@compiled
def _observe(state: PositionState, what: int, value: FloatArray, variance: float) -> None:
    """A place (what 0) or a velocity (1) of the reference point, (3,)."""
    for k in range(2):
        P, x = state.P[k], state.x
        told, total = (P[what, 0], P[what, 1], P[what, 2]), P[what, what] + variance
        gain = told[0] / total, told[1] / total, told[2] / total
        for i in range(3):
            for j in range(3):
                P[i, j] -= gain[i] * told[j]
        for axis in range(2 * k, 2 + k):
            innovation = value[axis] - x[axis, what]
            for i in range(3):
                x[axis, i] += gain[i] * innovation


@compiled
def _choose(
    contacts: Contacts, settings: PositionSettings, state: PositionState, resting: FloatArray, dt: float
) -> None:
    """The body stands on what it stood on as long as that rests, else on what has rested longest; it pushes
    off from it for a moment."""
    state.clock[1] += dt
    longest, chosen = 0.0, -1
    for s in contacts.segments:
        if resting[s] > longest:
            longest, chosen = resting[s], s
    standing = state.standing[0]
    if standing >= 0 and resting[standing] > 0.0:
        chosen = standing
    if chosen >= 0:
        state.standing[0], state.clock[1] = chosen, 0.0
    elif state.clock[1] > settings.push_off_s:
        state.standing[0] = -1
