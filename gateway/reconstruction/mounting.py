"""Find modules that are worn otherwise than the rig says, by how neighbours agree about their joints.

Every second each explanation is tried: one module is turned (by any of the 23 rotations that take a box to
itself), or two have changed places. An explanation makes other arms from module to joint, and its *gain* is
by how many nepers the disagreement falls, summed over the joints that it concerns:

    gain = Σ ½ ln((E + F) / (E_explained + F)),    E: mean square difference of the two accelerations

``F`` is what modules worn right disagree by: arms that are off by ``ARM_OFF`` (times the measured swing),
orientation errors (a share ``TILT_OFF`` of the acceleration) and the sensors' own ``NOISE``. Errors of soft
tissue, of arms or of sensors are in ``E`` and ``E_explained`` alike and cancel, so no gain comes of them. An
explanation holds that halves the disagreement: ``GAIN`` = ln 2. Headings are left free, since neighbours'
headings are found from the same accelerations.

A module without a position in the rig (zero) is not judged: its arms are not known.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, IntArray, StatusArray
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.reconstruction.inertial.observations import sensor_to_segment_matrices
from gateway.reconstruction.joint_agreement import (
    LEAST_ACCELERATION,
    AgreementState,
    Joints,
    JointSide,
    Products,
    is_common,
    pair,
    pairs_of,
)

JUDGED_EVERY_S = 1.0
GAIN = math.log(2.0)
STAYS_ABOVE = 0.5 * GAIN
"""An explanation is given up below that."""
CONFIRMED_BY = 2
"""Judgements in a row."""
ARM_OFF = 0.03
"""m: where a joint lies in a body of these lengths, and a module on its segment."""
TILT_OFF = 0.05
"""rad: 3°."""
NOISE = 0.05
"""m/s²."""
AS_GOOD = 0.8
"""Of the best explanation's gain: which of the two modules it is remains open."""
UNKNOWN = math.pi
"""rad: standard deviation of an unknown orientation."""
NOBODY = -1


class RigMounting(NamedTuple):
    """How the rig says that modules are worn, and how else they may be; constant."""

    is_known: StatusArray  # (n,) whether the rig says where the module sits
    R_bs: FloatArray  # (n, 3, 3)
    turns: FloatArray  # (23, 3, 3) the rotations of a box but the one that leaves it as it is


class MountingState(NamedTuple):
    """By segment, changed in place."""

    since_s: FloatArray  # (1,) last judgement
    partner: IntArray  # (n,) the explanation: itself: turned; another one: changed places; NOBODY: none
    turn: FloatArray  # (n, 3, 3) its segment axes to those in which the data came
    judged: IntArray  # (n,) judgements in a row that found one
    rival: IntArray  # (n,) another segment whose module would explain it as well, or NOBODY
    is_doubtful: StatusArray  # (n,)


def rig_mounting(suit: WornSuit) -> RigMounting:
    """Return what of a suit is needed to judge how its modules are worn."""
    arms = np.linalg.norm(np.asarray(suit.lever_arms, np.float64), axis=1)
    is_known = (suit.module_of_segment >= 0) & (arms > 0.0)
    return RigMounting(is_known.astype(np.uint8), sensor_to_segment_matrices(suit), _turns())


def _turns() -> FloatArray:
    """Return the rotations of a box but the one that leaves it as it is, (23, 3, 3)."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0 and np.trace(turn) < 3.0:
                found.append(turn)
    return np.stack(found)


def initial_mounting(n: int) -> MountingState:
    """Return the state of n segments before the first judgement."""
    nobody = np.full(n, NOBODY, np.int64)
    return MountingState(
        np.zeros(1), nobody.copy(), np.tile(np.eye(3), (n, 1, 1)), np.zeros(n, np.int64), nobody.copy(),
        np.zeros(n, np.uint8),
    )  # fmt: skip


class Arrangement(NamedTuple):
    """Whose data a segment has, and what turns its axes into those that they came in."""

    place: IntArray  # (n,)
    turn: FloatArray  # (n, 3, 3)


class Found(NamedTuple):
    """An explanation: ``second`` is ``first`` where that is turned."""

    gain: float
    first: int
    second: int
    turn: int


class Asked(NamedTuple):
    """By segment, of its joint to the parent; NaN where that cannot be asked."""

    difference: FloatArray  # (n,) mean square, (m/s²)²
    floor: FloatArray  # (n,) what of it is no wonder


class JointProducts(NamedTuple):
    """The joints and the sums of products of their modules."""

    sides: Records[JointSide]
    pairs: Records[Products]


def judge_mounting(joints: Joints, agreement: AgreementState, rig: RigMounting, state: MountingState) -> None:
    """Judge anew how all modules are worn, ``JUDGED_EVERY_S`` after the last time."""
    state.since_s[0] = 0.0
    n = len(joints.sides)
    now = Arrangement(np.arange(n), np.tile(np.eye(3), (n, 1, 1)))
    asked = _asked(joints, agreement, rig, now)
    explained: set[int] = set()
    for i in np.flatnonzero(state.is_doubtful):  # what still holds is not looked for again: that costs most
        asked = _kept(joints, agreement, state, now, asked, explained, int(i))
    while (found := _best(joints, agreement, rig, now, asked, explained)).gain >= GAIN:
        rival = _best(joints, agreement, rig, now, asked, explained | {found.first, found.second})
        is_open = found.first == found.second and rival.gain > AS_GOOD * found.gain
        _apply(rig, now, found)
        explained |= {found.first, found.second}
        for s in (found.first, found.second):
            state.rival[s] = rival.first if is_open else NOBODY
            state.partner[s], state.turn[s] = now.place[s], now.turn[s]
        asked = _explained(joints, agreement, now, asked, found)
    _settle(joints, agreement, state, now, asked, explained)


def _kept(
    joints: Joints,
    agreement: AgreementState,
    state: MountingState,
    now: Arrangement,
    asked: Asked,
    explained: set[int],
    s: int,
) -> Asked:
    """Take an earlier explanation over into ``now`` and ``explained`` where it still explains something."""
    partner = int(state.partner[s])
    if s in explained or partner in explained:
        return asked
    other = _as_before(state, now, s)
    if float(_gains(joints, agreement, other, asked, s, partner)[0]) < STAYS_ABOVE:
        return asked
    now.place[:], now.turn[:] = other.place, other.turn
    explained |= {s, partner}
    return _explained(joints, agreement, now, asked, Found(0.0, s, partner, 0))


def _as_before(state: MountingState, now: Arrangement, s: int) -> Arrangement:
    """Return ``now`` with segment s and its partner as they were explained earlier."""
    other = Arrangement(now.place.copy(), now.turn.copy())
    for i in {s, int(state.partner[s])}:
        other.place[i], other.turn[i] = state.partner[i], state.turn[i]
    return other


def _asked(joints: Joints, agreement: AgreementState, rig: RigMounting, now: Arrangement) -> Asked:
    """Return how the joints agree when all modules are worn as the rig says.

    The disagreement is found as that of every explanation: all that an explanation calls is compiled with the
    first judgement, not when the first explanation is found, which would stop a running gateway for seconds.
    """
    _, _, power, swing = pairs_of(joints.sides, agreement.pairs).T
    turned = _differences(joints, agreement, now, np.arange(len(joints.sides)))[0]
    is_known = (rig.is_known > 0) & (rig.is_known[joints.sides["parent"]] > 0)
    is_observable = (power >= LEAST_ACCELERATION**2) & is_known
    floor = ARM_OFF**2 * swing + TILT_OFF**2 * power + NOISE**2
    return Asked(np.where(is_observable, turned, np.nan), np.where(is_observable, floor, np.nan))


def _explained(
    joints: Joints, agreement: AgreementState, now: Arrangement, asked: Asked, found: Found
) -> Asked:
    """Return the same where an explanation is taken to be true."""
    difference, concerned = asked.difference.copy(), _concerned(joints, asked, found.first, found.second)
    after = _differences(joints, agreement, now, concerned)[0]
    difference[concerned] = np.where(np.isnan(after), difference[concerned], after)
    return Asked(difference, asked.floor)


def _settle(
    joints: Joints,
    agreement: AgreementState,
    state: MountingState,
    now: Arrangement,
    asked: Asked,
    explained: set[int],
) -> None:
    """Take explanations over; keep earlier ones until their joints agree without them."""
    for s in range(len(joints.sides)):
        if s in explained:
            state.judged[s] += 1
            state.is_doubtful[s] |= state.judged[s] >= CONFIRMED_BY
        elif not state.is_doubtful[s] or _is_over(joints, agreement, state, now, asked, explained, s):
            state.judged[s], state.partner[s], state.rival[s], state.is_doubtful[s] = 0, NOBODY, NOBODY, 0


def _is_over(
    joints: Joints,
    agreement: AgreementState,
    state: MountingState,
    now: Arrangement,
    asked: Asked,
    explained: set[int],
    s: int,
) -> bool:
    """Return whether the latest motion no longer supports an earlier explanation of segment s."""
    partner = int(state.partner[s])
    if partner in explained:
        return True  # that one has another explanation now
    other = _as_before(state, now, s)
    is_asked = bool(len(_concerned(joints, asked, s, partner)))
    return is_asked and float(_gains(joints, agreement, other, asked, s, partner)[0]) < STAYS_ABOVE


def _concerned(joints: Joints, asked: Asked, s: int, o: int) -> IntArray:
    """Return the joints that can be judged and that segment s or o is a part of."""
    has_part = np.isin(joints.sides["parent"], (s, o))
    has_part[[s, o]] = True
    return np.flatnonzero(has_part & np.isfinite(asked.floor))


def _best(
    joints: Joints,
    agreement: AgreementState,
    rig: RigMounting,
    now: Arrangement,
    asked: Asked,
    explained: set[int],
) -> Found:
    """Return the explanation of the largest gain, at least ``GAIN``, of segments not explained yet.

    Its gain is 0 if there is none.
    """
    best = Found(0.0, NOBODY, NOBODY, 0)
    largest = np.nan_to_num(0.5 * np.log1p(asked.difference / asked.floor))  # nepers, by joint
    if largest.sum() < GAIN:
        return best  # as in every suit that is worn right
    is_free = rig.is_known > 0
    is_free[list(explained)] = False
    at_work = Arrangement(now.place.copy(), now.turn.copy())
    measured = JointProducts(joints.sides, agreement.pairs)
    return Found(*_search(measured, at_work, rig, asked, largest, np.flatnonzero(is_free)))


@compiled
def _search(
    measured: JointProducts,
    now: Arrangement,
    rig: RigMounting,
    asked: Asked,
    largest: FloatArray,
    free: IntArray,
) -> tuple[float, int, int, int]:
    """Try all explanations of the segments ``free``; return the parts of a ``Found``.

    now: is worked on. largest: (n,) what a joint can gain at most, nepers.
    """
    gain, first, second, best_turn = 0.0, NOBODY, NOBODY, 0
    sides, place, turn = measured.sides, now.place, now.turn
    for a in range(len(free)):
        for b in range(a, len(free)):
            s, o, reach = free[a], free[b], 0.0
            for j in range(len(sides)):
                if _has_part(sides, asked.floor, j, s, o):
                    reach += largest[j]
            if reach < max(GAIN, gain):
                continue

            turn_s, turn_o = turn[s].copy(), turn[o].copy()
            place[s], place[o] = place[o], place[s]
            for h in range(len(rig.turns) if s == o else 1):
                if s == o:
                    turn[s] = rig.turns[h]
                else:
                    _exchange(turn, rig.R_bs, s, o)
                total = 0.0
                for j in range(len(sides)):
                    if _has_part(sides, asked.floor, j, s, o):
                        after, floor = _difference(measured, place, turn, j), asked.floor[j]
                        gained = 0.5 * math.log((asked.difference[j] + floor) / (after + floor))
                        total += 0.0 if math.isnan(gained) else gained
                if total > gain:
                    gain, first, second, best_turn = total, s, o, h

            place[s], place[o] = place[o], place[s]
            turn[s], turn[o] = turn_s, turn_o
    return gain, first, second, best_turn


@compiled
def _has_part(sides: Records[JointSide], floor: FloatArray, j: int, s: int, o: int) -> bool:
    """Return whether a joint can be judged and segment s or o is a part of it."""
    return math.isfinite(floor[j]) and (j in (s, o) or sides[j].parent in (s, o))


@compiled
def _exchange(turn: FloatArray, R_bs: FloatArray, s: int, o: int) -> None:
    """Turn two segments (n, 3, 3) as if their modules had changed places."""
    for i in range(3):
        for k in range(3):
            turn[s, i, k] = turn[o, i, k] = 0.0
            for m in range(3):
                turn[s, i, k] += R_bs[o, i, m] * R_bs[s, k, m]
                turn[o, i, k] += R_bs[s, i, m] * R_bs[o, k, m]


def _apply(rig: RigMounting, to: Arrangement, found: Found) -> None:
    """Arrange segments as an explanation says, in place."""
    s, o = found.first, found.second
    if s == o:
        to.turn[s] = rig.turns[found.turn]
        return
    to.place[s], to.place[o] = o, s
    to.turn[s], to.turn[o] = rig.R_bs[o] @ rig.R_bs[s].T, rig.R_bs[s] @ rig.R_bs[o].T


def _gains(
    joints: Joints, agreement: AgreementState, other: Arrangement, asked: Asked, s: int, o: int
) -> FloatArray:
    """Return by how many nepers arrangements lower the disagreements of joints, (H,).

    The joints are those of segments s and o. other: with one turn (n, 3, 3), or H of them (H, n, 3, 3).
    """
    concerned = _concerned(joints, asked, s, o)
    after = _differences(joints, agreement, other, concerned)
    before, floor = asked.difference[concerned], asked.floor[concerned]
    gains: FloatArray = np.nan_to_num(0.5 * np.log((before + floor) / (after + floor))).sum(axis=1)
    return gains


def _differences(
    joints: Joints, agreement: AgreementState, now: Arrangement, concerned: IntArray
) -> FloatArray:
    """Return ``Pair.turned`` of joints, (H, k); NaN where the two modules have not sent together."""
    turn = now.turn.reshape(-1, *now.turn.shape[-3:])
    return _arranged(JointProducts(joints.sides, agreement.pairs), now.place, turn, concerned)


@compiled
def _arranged(measured: JointProducts, place: IntArray, turn: FloatArray, concerned: IntArray) -> FloatArray:
    found = np.empty((len(turn), len(concerned)))
    for h in range(len(turn)):
        for c in range(len(concerned)):
            found[h, c] = _difference(measured, place, turn[h], concerned[c])
    return found


@compiled
def _difference(measured: JointProducts, place: IntArray, turn: FloatArray, j: int) -> float:
    """Return ``Pair.turned`` of a joint; NaN where the two modules have not sent together."""
    side, p = measured.sides[j], measured.sides[j].parent
    if not is_common(measured.pairs, place[j], place[p]):
        return math.nan
    arm, arm_p = np.zeros(3), np.zeros(3)
    for row in range(3):
        for m in range(3):
            arm[row] += turn[j, row, m] * side.from_child[m]
            arm_p[row] += turn[p, row, m] * side.from_parent[m]
    turned: float = pair(measured.pairs, place[j], arm, place[p], arm_p).turned
    return turned
