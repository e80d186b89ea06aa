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
from collections.abc import Collection
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
    judgement = _Judgement(JointProducts(joints.sides, agreement.pairs), rig, state)
    for i in np.flatnonzero(state.is_doubtful):  # what still holds is not looked for again: that costs most
        judgement.keep(int(i))
    while (found := judgement.best()).gain >= GAIN:
        judgement.take(found)
    judgement.settle()


class _Judgement:
    """How modules of n segments seem to be worn by the last seconds, explanation after explanation."""

    def __init__(self, measured: JointProducts, rig: RigMounting, state: MountingState) -> None:
        """Begin with all modules as the rig says; ``state``, the judgement before, is changed."""
        n = len(measured.sides)
        self._measured, self._rig, self._state = measured, rig, state
        self._now = Arrangement(np.arange(n), np.tile(np.eye(3), (n, 1, 1)))
        self._asked = self._as_in_the_rig()
        self._explained: set[int] = set()
        """Segments that have an explanation in this judgement."""

    def _as_in_the_rig(self) -> Asked:
        """Return how the joints agree when all modules are worn as the rig says.

        The disagreement is found as that of every explanation: all that an explanation calls is compiled with
        the first judgement, not when the first explanation is found, which would stop a running gateway for
        seconds.
        """
        sides, is_known = self._measured.sides, self._rig.is_known
        _, _, power, swing = pairs_of(sides, self._measured.pairs).T
        turned = self._differences(self._now, np.arange(len(sides)))
        is_observable = (power >= LEAST_ACCELERATION**2) & (is_known > 0) & (is_known[sides["parent"]] > 0)
        floor = ARM_OFF**2 * swing + TILT_OFF**2 * power + NOISE**2
        return Asked(np.where(is_observable, turned, np.nan), np.where(is_observable, floor, np.nan))

    def keep(self, s: int) -> None:
        """Take an earlier explanation of segment s over where it still explains something."""
        partner = int(self._state.partner[s])
        if s in self._explained or partner in self._explained:
            return
        other = self._as_before(s)
        if self._gain(other, s, partner) < STAYS_ABOVE:
            return
        self._now.place[:], self._now.turn[:] = other.place, other.turn
        self._explain(s, partner)

    def take(self, found: Found) -> None:
        """Take an explanation for true, and note whether another one would be as good."""
        first, second, state = found.first, found.second, self._state
        rival = self.best({first, second})
        is_open = first == second and rival.gain > AS_GOOD * found.gain
        _apply(self._rig, self._now, found)
        for s in (first, second):
            state.rival[s] = rival.first if is_open else NOBODY
            state.partner[s], state.turn[s] = self._now.place[s], self._now.turn[s]
        self._explain(first, second)

    def best(self, beside: Collection[int] = ()) -> Found:
        """Return the explanation of the largest gain, at least ``GAIN``, of segments not explained yet.

        Its gain is 0 if there is none. beside: segments that count as explained, too.
        """
        asked, now = self._asked, self._now
        largest = np.nan_to_num(0.5 * np.log1p(asked.difference / asked.floor))  # nepers, by joint
        if largest.sum() < GAIN:
            return Found(0.0, NOBODY, NOBODY, 0)  # as in every suit that is worn right
        is_free = self._rig.is_known > 0
        is_free[list(self._explained.union(beside))] = False
        at_work = Arrangement(now.place.copy(), now.turn.copy())
        free = np.flatnonzero(is_free)
        return Found(*_search(self._measured, at_work, self._rig, asked, largest, free))

    def settle(self) -> None:
        """Take explanations over into the state; keep earlier ones until their joints agree without them."""
        state = self._state
        for s in range(len(self._measured.sides)):
            if s in self._explained:
                state.judged[s] += 1
                state.is_doubtful[s] |= state.judged[s] >= CONFIRMED_BY
            elif not state.is_doubtful[s] or self._is_over(s):
                state.judged[s], state.partner[s], state.rival[s], state.is_doubtful[s] = 0, NOBODY, NOBODY, 0

    def _is_over(self, s: int) -> bool:
        """Return whether the latest motion no longer supports an earlier explanation of segment s."""
        partner = int(self._state.partner[s])
        if partner in self._explained:
            return True  # that one has another explanation now
        is_asked = bool(len(self._concerned(s, partner)))
        return is_asked and self._gain(self._as_before(s), s, partner) < STAYS_ABOVE

    def _explain(self, s: int, o: int) -> None:
        """Ask the joints of two segments anew, as they are arranged now."""
        self._explained |= {s, o}
        difference, concerned = self._asked.difference.copy(), self._concerned(s, o)
        after = self._differences(self._now, concerned)
        difference[concerned] = np.where(np.isnan(after), difference[concerned], after)
        self._asked = self._asked._replace(difference=difference)

    def _as_before(self, s: int) -> Arrangement:
        """Return the arrangement with segment s and its partner as they were explained earlier."""
        other = Arrangement(self._now.place.copy(), self._now.turn.copy())
        for i in {s, int(self._state.partner[s])}:
            other.place[i], other.turn[i] = self._state.partner[i], self._state.turn[i]
        return other

    def _concerned(self, s: int, o: int) -> IntArray:
        """Return the joints that can be judged and that segment s or o is a part of."""
        has_part = np.isin(self._measured.sides["parent"], (s, o))
        has_part[[s, o]] = True
        return np.flatnonzero(has_part & np.isfinite(self._asked.floor))

    def _gain(self, other: Arrangement, s: int, o: int) -> float:
        """Return by how many nepers an arrangement lowers the disagreements of the joints of two segments."""
        concerned = self._concerned(s, o)
        after = self._differences(other, concerned)
        before, floor = self._asked.difference[concerned], self._asked.floor[concerned]
        return float(np.nan_to_num(0.5 * np.log((before + floor) / (after + floor))).sum())

    def _differences(self, arrangement: Arrangement, concerned: IntArray) -> FloatArray:
        """Return ``Pair.turned`` of joints (k,); NaN where the two modules have not sent together."""
        return _arranged(self._measured, arrangement.place, arrangement.turn, concerned)


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


@compiled
def _arranged(measured: JointProducts, place: IntArray, turn: FloatArray, concerned: IntArray) -> FloatArray:
    found = np.empty(len(concerned))
    for c in range(len(concerned)):
        found[c] = _difference(measured, place, turn, concerned[c])
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
