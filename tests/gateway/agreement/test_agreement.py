"""Two views of one known motion: every constant that was put between them is found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.agreement import Tracks, agreement
from gateway.agreement.time_alignment import align_time
from gateway.errors import GatewayError

NAMES = ("pelvis", "thigh", "shank")
PARENTS = (-1, 0, 1)


def motion(time_s, seed=1):
    """(T, 3, 4) and (T, 3, 3): smooth, aperiodic over minutes, another for every segment."""
    rng = np.random.default_rng(seed)
    q, p = [], []
    for s in range(3):
        f, phase = rng.uniform(0.1, 0.9, (2, 3, 4))
        phase = phase * 20.0
        vectors = sum(np.sin(2 * np.pi * f[:, i] * time_s[:, None] + phase[:, i]) for i in range(4)) * 0.3
        q.append(Rotation.from_rotvec(vectors).as_quat(scalar_first=True))
        p.append(np.cumsum(vectors, axis=0) * 0.002 + s)
    return np.stack(q, axis=1), np.stack(p, axis=1)


def first_and_second(lag_s=1.2345, ppm=0.0, heading_deg=70.0, noise_deg=0.0, seconds=30.0, gap=None):
    """The second: another clock, heading, rate, and axes of the segments 10, 20, 30° off."""
    time_a = np.arange(0.0, seconds, 0.01)
    q_a, p_a = motion(time_a)
    begin, rate = 2.0, 1.0 / 120.0
    true = np.arange(begin, seconds - 1.0, rate)
    middle = 0.5 * (begin + seconds - 1.0)
    q_b, p_b = motion(true)
    # the places are a running sum: the same ones at the same instants by interpolation
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(heading_deg)])
    rng = np.random.default_rng(5)
    for s in range(3):
        mounting = Rotation.from_rotvec(np.radians(10.0 * (s + 1)) * np.array([0.6, 0.0, 0.8]))
        noise = Rotation.from_rotvec(rng.normal(0.0, np.radians(noise_deg), (len(time_a), 3)))
        q_a[:, s] = (Rotation.from_quat(q_a[:, s], scalar_first=True) * noise).as_quat(scalar_first=True)
        own = Rotation.from_quat(q_b[:, s], scalar_first=True)
        q_b[:, s] = (turn * own * mounting).as_quat(scalar_first=True)
    if gap is not None:
        q_b[(true > gap[0]) & (true < gap[1]), 1] = np.nan
    for s in range(3):
        same = np.stack([np.interp(true, time_a, p_a[:, s, i]) for i in range(3)], axis=1)
        p_b[:, s] = turn.apply(same) + np.array([3.0, -2.0, 0.1])
    clock_b = true + lag_s + ppm * 1e-6 * (true - middle)
    return Tracks(NAMES, PARENTS, time_a, q_a, p_a), Tracks(NAMES, PARENTS, clock_b, q_b, p_b)


@pytest.mark.parametrize("lag_s", [-7.3, -0.0042, 1.2345, 100.0])
def test_finds_lag_heading_and_axes(lag_s):
    found = agreement(*first_and_second(lag_s))
    assert found.time.lag_s == pytest.approx(lag_s, abs=5e-4)
    assert found.time.correlation > 0.99
    assert found.heading_deg == pytest.approx(70.0, abs=0.1)
    for s, figures in enumerate(found.segments):
        assert figures.axes_apart_deg == pytest.approx(10.0 * (s + 1), abs=0.1)
        assert figures.as_defined_rms_deg > 5.0
        assert figures.rms_deg < 0.15
        assert figures.position_rms_m < 2e-3
    assert np.isnan(found.segments[0].joint_rms_deg)
    assert found.segments[1].joint_rms_deg < 0.2


@pytest.mark.parametrize("own_headings", [False, True])
def test_a_segment_that_one_never_measured_has_no_figures_and_spoils_no_others(own_headings: bool):
    first, second = first_and_second()
    first.q_wb[:, 2] = np.nan
    found = agreement(first, second, own_headings=own_headings)
    assert found.segments[2].frames == 0
    assert np.isnan(found.segments[2].rms_deg)
    assert all(figures.rms_deg < 0.15 for figures in found.segments[:2])


def test_a_segment_that_spins_in_one_of_them_does_not_tell_the_lag():
    """As a hand with one marker may: about any axis, at any speed."""
    first, second = first_and_second(1.2345)
    q = second.q_wb.copy()
    rates = np.random.default_rng(2).normal(0.0, 0.6, (len(q), 3))
    turning = Rotation.identity()
    for f, rate in enumerate(rates):
        turning = turning * Rotation.from_rotvec(rate)
        q[f, 2] = turning.as_quat(scalar_first=True)
    found = align_time(first, replace(second, q_wb=q))
    assert found.lag_s == pytest.approx(1.2345, abs=2e-3)
    assert found.correlation > 0.7


def test_a_segment_that_is_hardly_known_does_not_move_the_lag():
    """It moves most, half as it really does and late, half by itself: a hand that carries one marker."""
    first, second = first_and_second(0.0)
    true, stray = Rotation.from_quat(second.q_wb[:, 2], scalar_first=True).as_rotvec(), second.time_s[:, None]
    vectors = np.roll(true, 4, axis=0) + np.sin(stray * [7.1, 8.3, 9.7]) * 0.3
    q = second.q_wb.copy()
    q[:, 2] = Rotation.from_rotvec(vectors).as_quat(scalar_first=True)
    assert align_time(first, replace(second, q_wb=q)).lag_s == pytest.approx(0.0, abs=1.5e-3)


def test_noise_is_stated_as_it_is():
    found = agreement(*first_and_second(noise_deg=1.0))
    for figures in found.segments:
        assert figures.rms_deg == pytest.approx(np.sqrt(3.0), rel=0.1)
        assert figures.p95_deg == pytest.approx(2.8, rel=0.1)
    assert found.segments[1].joint_rms_deg == pytest.approx(np.sqrt(6.0), rel=0.1)


def test_finds_the_drift_of_a_clock():
    first, second = first_and_second(lag_s=0.5, ppm=200.0, seconds=90.0)
    found = align_time(first, second)
    assert found.drift_ppm == pytest.approx(200.0, abs=5.0)
    assert max(figures.rms_deg for figures in agreement(first, second).segments) < 0.15


def test_segments_of_other_names_and_gaps():
    first, second = first_and_second(gap=(5.0, 15.0))
    second = Tracks(("hips", "left_thigh", "shank"), second.parents, second.time_s, second.q_wb, second.p_w)
    found = agreement(first, second, {"thigh": "left_thigh"})
    assert [figures.second_segment for figures in found.segments] == ["left_thigh", "shank"]
    assert found.only_in_first == ("pelvis",)
    assert found.only_in_second == ("hips",)
    assert found.segments[0].frames < found.segments[1].frames - 900
    assert found.segments[0].rms_deg < 0.15


def test_a_lag_beyond_the_search_is_not_found():
    first, second = first_and_second(lag_s=3.0)
    assert align_time(first, second, largest_lag_s=1.0).correlation < 0.7
    assert align_time(first, second, largest_lag_s=4.0).lag_s == pytest.approx(3.0, abs=1e-3)


def test_refuses_what_cannot_be_compared():
    first, second = first_and_second()
    still = Tracks(NAMES, PARENTS, first.time_s, np.broadcast_to(first.q_wb[:1], first.q_wb.shape), first.p_w)
    with pytest.raises(GatewayError, match="nothing moves in the second"):
        agreement(first, still)
    strange = Tracks(("a", "b", "c"), PARENTS, second.time_s, second.q_wb, second.p_w)
    with pytest.raises(GatewayError, match="no segment has the same name"):
        agreement(first, strange)
    with pytest.raises(GatewayError, match="no segment 'x'"):
        agreement(first, second, {"pelvis": "x"})


def test_a_few_frames_beside_a_pause_are_no_agreement():
    """Two other motions, paused alike, correlated by 0.9 where five frames of one met the other."""
    first, second = first_and_second()
    stranger, _ = motion(second.time_s, seed=7)
    paused = [
        replace(each, time_s=each.time_s + np.where(each.time_s > 3.0 + lag_s, 120.0, 0.0))
        for each, lag_s in ((first, 0.0), (second, 1.2345))
    ]
    found = agreement(paused[0], replace(paused[1], q_wb=stranger))
    assert found.time.correlation < 0.7
    assert agreement(*paused).time.correlation > 0.99
