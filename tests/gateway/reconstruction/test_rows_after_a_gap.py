"""A module comes back in mid-swing: what aids its chain still does, and one instant is no mean."""

import numpy as np
import pytest

from gateway.emulation.fast_arm import fast_arm
from gateway.reconstruction.inertial.tree import devices as tree_devices
from gateway.reconstruction.inertial.tree import rows as tree_rows
from gateway.reconstruction.inertial.tree.prediction import average
from gateway.reconstruction.inertial.tree.state import Validity, chain_body, initial_state, work_space
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.inertial.tree.unaided import speed_row

DT, TUNING = 0.01, tuning()
BODY = chain_body(fast_arm(), uses_field=False)
N = len(BODY.segments)


def information_of_a_velocity_since(seconds):
    """Of an unaided row about tilt, rad⁻², after a module has not moved for so long."""
    state, work = initial_state(1, 1), work_space(1)
    segment, now = state.segments[0], work.segments[0]
    segment.velocity.tilted_s, segment.velocity.variance = seconds, TUNING.unaided_speed**2
    speed_row(now, segment, BODY.world, 100.0 * TUNING.unaided_speed**2, 1, TUNING)
    return now.evidence.own[0, 0]


def test_the_longer_a_velocity_has_been_felt_the_more_it_tells_where_down_is():
    whole = information_of_a_velocity_since(1.0)
    assert information_of_a_velocity_since(10.0) == pytest.approx(100.0 * whole)
    assert information_of_a_velocity_since(0.1) == pytest.approx(0.01 * whole)


@pytest.mark.parametrize("fresh_s", [0.02, 10.0])
def test_a_chain_is_held_up_also_while_its_rows_wait_for_their_averages(fresh_s, monkeypatch):
    """Else every segment's specific force of the moment would count as gravity."""
    state, work = initial_state(N, 1), work_space(N)
    state.segments["averages"]["seconds"] = fresh_s
    work.segments["validity"] = Validity.FORCE
    rows = []
    monkeypatch.setattr(tree_rows, "_joint_row", lambda *a: rows.append(a))
    monkeypatch.setattr(tree_devices, "_fixed_row", lambda *a: rows.append(a))
    tree_devices.device_rows.__wrapped__(BODY, state, TUNING, work, DT)
    tree_rows.joint_rows.__wrapped__(BODY, state, TUNING, work, DT)
    assert work.segments["chain"].tolist() == [0] * N
    assert work.segments[0].aided == 1
    assert len(rows) == (N if fresh_s > 1.0 else 0)


def test_averages_begun_in_motion_are_means_of_what_came_since():
    """A segment that turns evenly: its swing is R [ω]×² and a point on it feels that much, at once."""
    state, work, omega = initial_state(1, 0), work_space(1), 8.0
    segment, now = state.segments[0], work.segments[0]
    now.validity, now.is_felt, arm = Validity.FORCE, 1, np.array([0.3, 0.0, 0.0])
    for k in range(8):
        angle = omega * DT * k
        c, s = np.cos(angle), np.sin(angle)
        segment.R[...] = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
        now.specific_force[...] = -(omega**2) * arm[0], 0.0, 9.81  # at the arm's end, segment axes
        now.angular_rate[...] = 0.0, 0.0, omega
        average(state, TUNING, work, DT)
        if k > 0:
            at_axis = segment.averages.force - now.K @ arm
            np.testing.assert_allclose(at_axis, [0.0, 0.0, 9.81], atol=0.05)
