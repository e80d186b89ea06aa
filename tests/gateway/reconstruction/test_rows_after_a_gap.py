"""A module comes back in mid-swing: what holds its chain up still does, and one instant is no mean."""

import numpy as np
import pytest

from gateway.emulation.fast_arm import fast_arm
from gateway.reconstruction.inertial import chain_step, device_rows
from gateway.reconstruction.inertial.chain_averages import average
from gateway.reconstruction.inertial.chain_rows import unaided_row
from gateway.reconstruction.inertial.chain_scratch import scratch as scratch_of
from gateway.reconstruction.inertial.chain_state import Noise, chain_body, initial_state
from gateway.reconstruction.inertial.tree_filter import no_evidence

DT = 0.01
BODY = chain_body(fast_arm(), uses_field=False)
N = len(BODY.parents)


def information_of_a_mean_over(seconds):
    """Of an unaided row about tilt, rad⁻²: the mean specific force is gravity."""
    evidence, state = no_evidence(N), initial_state(N, 1)
    state.fresh_s[:] = seconds
    state.long_force[:] = BODY.at_rest
    unaided_row(evidence, state, Noise(), 0, BODY.at_rest, 1.0, DT)
    return evidence.own[0, 0, 0]


def test_the_shorter_a_mean_has_lasted_the_less_it_tells_where_down_is():
    whole = information_of_a_mean_over(Noise().unaided_window_s)
    assert information_of_a_mean_over(10.0) == pytest.approx(whole)
    assert information_of_a_mean_over(0.1) == pytest.approx(0.01 * whole)
    assert information_of_a_mean_over(0.0) == pytest.approx(DT**2 * whole)


@pytest.mark.parametrize("fresh_s", [0.02, 10.0])
def test_a_chain_is_held_up_also_while_its_rows_wait_for_their_averages(fresh_s, monkeypatch):
    """Else every segment's specific force of the moment would count as gravity."""
    state, scratch = initial_state(N, 1), chain_step_scratch()
    state.fresh_s[:] = fresh_s
    rows = []
    monkeypatch.setattr(chain_step, "_joint_row", lambda *a: rows.append(a))
    monkeypatch.setattr(device_rows, "_fixed_row", lambda *a: rows.append(a))
    monkeypatch.setattr(chain_step, "_unaided_rows", lambda *a: None)
    device_rows.device_rows.__wrapped__(BODY, state, Noise(), scratch, np.ones(1, np.int64), DT, 1.0)
    chain_step._joint_rows.__wrapped__(BODY, state, Noise(), scratch, True, DT)
    assert scratch.chain.tolist() == [0] * N
    assert scratch.anchored[0] == 1.0
    assert len(rows) == (N if fresh_s > 1.0 else 0)


def chain_step_scratch():
    """Of segments whose modules all speak."""
    made = scratch_of(N)
    made.is_valid[:] = 2.0
    return made


def test_averages_begun_in_motion_are_means_of_what_came_since():
    """A segment that turns evenly: its swing is R [ω]×² and a point on it feels that much, at once."""
    state, noise = initial_state(1, 0), Noise()
    body = chain_body(fast_arm(), uses_field=False)._replace(parents=np.array([-1]))
    omega, K, motion = 8.0, np.zeros((1, 3, 3)), np.zeros(1)
    arm = np.array([0.3, 0.0, 0.0])
    for k in range(8):
        angle = omega * DT * k
        c, s = np.cos(angle), np.sin(angle)
        state.R[0] = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
        felt = np.array([[-(omega**2) * arm[0], 0.0, 9.81]])  # at the arm's end, segment axes
        rate = np.array([[0.0, 0.0, omega]])
        average(body, state, noise, felt, rate, np.full(1, 2.0), DT, K, motion)
        if k > 0:
            at_axis = state.force[0] - K[0] @ arm
            np.testing.assert_allclose(at_axis, [0.0, 0.0, 9.81], atol=0.05)
