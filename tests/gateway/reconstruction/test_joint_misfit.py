"""Joints whose two sides disagree all the time: modules worn otherwise than the rig says."""

import numpy as np
import pytest

from gateway.emulation.fast_arm import fast_arm
from gateway.reconstruction.inertial import chain_step
from gateway.reconstruction.inertial.chain_rows import LOOSE, joint_row
from gateway.reconstruction.inertial.chain_scratch import scratch
from gateway.reconstruction.inertial.chain_state import Noise, chain_body, initial_state
from gateway.reconstruction.inertial.tree_filter import no_evidence

DT, SURE, N = 0.01, 1e-6, 5
"""s; rad² of orientations that are known; segments."""
BODY = chain_body(fast_arm(), uses_field=False)


def after(seconds, off, state=None):
    """State, and what the last row tells, of a joint of 10 m/s² whose sides are apart by ``off`` times what a
    single row is expected to be off by."""
    state = state or initial_state(N, 1)
    variance = 0.04
    apart = off * np.sqrt(variance * DT / Noise().row_memory_s) * np.array([1.0, -1.0, 1.0])
    for _ in range(round(seconds / DT)):
        evidence = no_evidence(N)
        state.P[:, :3, :3] = SURE * np.eye(3)  # shown by others
        u_p = np.array([0.0, 0.0, 10.0])
        joint_row(evidence, state, Noise(), 2, 1, u_p + apart, u_p, variance, DT, False)
    return state, evidence.cc[2, 0, 0]


def test_a_joint_that_fits_tells_what_its_noise_allows():
    state, told = after(10.0, 0.9)
    assert state.misfit[2] == pytest.approx(0.7, abs=0.1)
    assert told == pytest.approx(10.0**2 / 0.04, rel=0.02)


def test_a_joint_that_fits_badly_tells_less():
    _, well = after(10.0, 0.9)
    state, told = after(30.0, 2.0)
    assert state.misfit[2] == pytest.approx(4.0, rel=0.05)
    assert told == pytest.approx(well / 4.0, rel=0.1)


def test_a_joint_that_does_not_fit_tells_nothing_and_takes_back_what_it_told():
    state, told = after(5.0, 10.0)
    assert state.misfit[2] > LOOSE
    assert told == 0.0
    state, told = after(20.0, 0.9, state)
    assert state.misfit[2] < LOOSE
    assert told > 0.0  # it fits again


def test_where_a_joint_comes_loose_its_segment_is_as_unsure_as_at_its_start():
    state = initial_state(N, 1)
    while state.misfit[2] < LOOSE:
        after(DT, 10.0, state)
    np.testing.assert_allclose(np.sqrt(np.diag(state.P[2])[:3]), [0.3, 0.3, 0.5], rtol=1e-3)


def test_a_joint_that_does_not_fit_holds_nothing_up(monkeypatch):
    state = initial_state(N, 1)
    state.fresh_s[:] = 10.0
    state.misfit[3] = 100.0
    made = scratch(N)
    made.is_valid[:] = 2.0
    monkeypatch.setattr(chain_step, "_joint_row", lambda *a: None)
    monkeypatch.setattr(chain_step, "_unaided_rows", lambda *a: None)
    chain_step._joint_rows.__wrapped__(BODY, state, Noise(), made, True, DT)
    assert made.chain.tolist() == [0, 0, 0, 3, 3]
