"""Joints whose two sides disagree all the time: modules worn otherwise than the rig says."""

import numpy as np
import pytest

from gateway.emulation.fast_arm import fast_arm
from gateway.reconstruction.inertial.tree import rows
from gateway.reconstruction.inertial.tree.rows import joint_row
from gateway.reconstruction.inertial.tree.state import Joint, Validity, chain_body, initial_state, work_space
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.inertial.tree.update import clear

DT, SURE, N = 0.01, 1e-6, 5
"""s; rad² of orientations that are known; segments."""
BODY, TUNING = chain_body(fast_arm(), uses_field=False), tuning()


def after(seconds, off, segments=None):
    """Segments, and what the last row tells, of a joint of 10 m/s² whose sides are apart by ``off`` times
    what a single row is expected to be off by."""
    segments = initial_state(N, 1).segments if segments is None else segments
    variance, work = 0.04, work_space(N).segments
    now = work[2]
    joint = Joint(BODY.segments[2], segments[2], segments[1], now, work[1])
    apart = off * np.sqrt(variance * DT / TUNING.row_memory_s) * np.array([1.0, -1.0, 1.0])
    for _ in range(round(seconds / DT)):
        clear(now.evidence)
        segments["P"][:, :3, :3] = SURE * np.eye(3)  # shown by others
        now.u_parent[...] = 0.0, 0.0, 10.0
        now.u[...] = now.u_parent + apart
        now.row_variance = variance
        joint_row(joint, False, TUNING, DT)
    return segments, now.evidence.cc[0, 0]


def test_a_joint_that_fits_tells_what_its_noise_allows():
    segments, told = after(10.0, 0.9)
    assert segments[2].joint_nis == pytest.approx(0.7, abs=0.1)
    assert told == pytest.approx(10.0**2 / 0.04, rel=0.02)


def test_a_joint_that_fits_badly_tells_less():
    _, well = after(10.0, 0.9)
    segments, told = after(30.0, 2.0)
    assert segments[2].joint_nis == pytest.approx(4.0, rel=0.05)
    assert told == pytest.approx(well / 4.0, rel=0.1)


def test_a_joint_that_does_not_fit_tells_nothing_and_takes_back_what_it_told():
    segments, told = after(5.0, 10.0)
    assert segments[2].joint_nis > TUNING.loose_nis
    assert told == 0.0
    segments, told = after(20.0, 0.9, segments)
    assert segments[2].joint_nis < TUNING.loose_nis
    assert told > 0.0  # it fits again


def test_where_a_joint_comes_loose_its_segment_is_as_unsure_as_at_its_start():
    segments = initial_state(N, 1).segments
    while segments[2].joint_nis < TUNING.loose_nis:
        after(DT, 10.0, segments)
    np.testing.assert_allclose(np.sqrt(np.diag(segments[2].P)[:3]), [0.3, 0.3, 0.5], rtol=1e-3)


def test_a_joint_that_does_not_fit_holds_nothing_up(monkeypatch):
    state, work = initial_state(N, 1), work_space(N)
    state.segments["averages"]["seconds"] = 10.0
    state.segments["joint_nis"][3] = 100.0
    work.segments["validity"] = Validity.FORCE
    monkeypatch.setattr(rows, "_joint_row", lambda *a: None)
    rows.joint_rows.__wrapped__(BODY, state, TUNING, work, DT)
    assert work.segments["chain"].tolist() == [0, 0, 0, 3, 3]
