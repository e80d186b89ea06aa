"""Segments without module: between two others by the body's rules, else with their parent."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.body.body_file import load_body
from gateway.body.interpolation import BETWEEN_SIGMA, FOLLOWING_SIGMA, follow, following_rules
from gateway.body.rig import load_rig
from gateway.errors import SettingsError
from gateway.frames import Status


@pytest.fixture
def suit():
    return load_rig("suit_23_from_17")


def pose(suit, **turns):
    """q_wb, rate, sigma, status; named segments turned about z by so many rad from the neutral posture."""
    skeleton = suit.skeleton
    n = skeleton.n_segments
    q = np.tile(skeleton.neutral, (n, 1))
    for name, angle in turns.items():
        turned = Rotation.from_quat(skeleton.neutral, scalar_first=True) * Rotation.from_rotvec([0, 0, angle])
        q[skeleton.index(name)] = turned.as_quat(scalar_first=True)
    return q, np.zeros((n, 3)), np.full(n, 0.02), np.zeros(n, np.uint8)


def test_the_spine_bends_by_even_shares(suit):
    q, rate, sigma, status = pose(suit, thorax=0.8)
    follow(following_rules(suit), q, rate, sigma, status)
    neutral = Rotation.from_quat(suit.skeleton.neutral, scalar_first=True)
    for name, share in (("l5", 0.25), ("l3", 0.5), ("t12", 0.75)):
        s = suit.skeleton.index(name)
        bend = neutral.inv() * Rotation.from_quat(q[s], scalar_first=True)
        np.testing.assert_allclose(bend.as_rotvec(), [0, 0, 0.8 * share], atol=1e-12)
        assert status[s] == Status.PREDICTED
        assert sigma[s] > BETWEEN_SIGMA


def test_more_bend_is_less_sure(suit):
    s, sigmas = suit.skeleton.index("l3"), []
    for bend in (0.0, 0.3, 0.9):
        q, rate, sigma, status = pose(suit, thorax=bend)
        follow(following_rules(suit), q, rate, sigma, status)
        sigmas.append(sigma[s])
    assert sigmas == sorted(set(sigmas))


def test_toes_follow_their_foot(suit):
    q, rate, sigma, status = pose(suit, left_foot=0.5)
    follow(following_rules(suit), q, rate, sigma, status)
    foot, toes = suit.skeleton.index("left_foot"), suit.skeleton.index("left_toes")
    np.testing.assert_array_equal(q[toes], q[foot])
    assert sigma[toes] == pytest.approx(np.hypot(0.02, FOLLOWING_SIGMA))
    assert status[toes] == Status.PREDICTED


def test_rates_are_those_of_the_interpolated_turn(suit):
    """Against a difference of two poses a moment apart."""
    speed, dt, s = 1.3, 1e-6, suit.skeleton.index("t12")
    ends = []
    for moment in (0.4, 0.4 + speed * dt):
        q, rate, sigma, status = pose(suit, thorax=moment)
        rate[suit.skeleton.index("thorax")] = [0, 0, speed]
        follow(following_rules(suit), q, rate, sigma, status)
        ends.append(Rotation.from_quat(q[s], scalar_first=True))
    np.testing.assert_allclose(rate[s], (ends[0].inv() * ends[1]).as_rotvec() / dt, atol=1e-4)


def test_one_end_alone_is_followed_and_none_is_missing(suit):
    q, rate, sigma, status = pose(suit, pelvis=0.3)
    thorax, l3 = suit.skeleton.index("thorax"), suit.skeleton.index("l3")
    q[thorax], status[thorax] = np.nan, Status.MISSING
    follow(following_rules(suit), q, rate, sigma, status)
    np.testing.assert_array_equal(q[l3], q[suit.skeleton.index("pelvis")])
    q[0], status[0] = np.nan, Status.MISSING
    follow(following_rules(suit), q, rate, sigma, status)
    assert np.isnan(q[l3]).all()
    assert status[l3] == Status.MISSING


def test_segments_with_modules_are_left_alone(suit):
    q, rate, sigma, status = pose(suit, thorax=0.8, head=-0.3)
    before = q.copy()
    follow(following_rules(suit), q, rate, sigma, status)
    worn = suit.module_of_segment >= 0
    np.testing.assert_array_equal(q[worn], before[worn])
    assert worn.sum() == 17
    assert (status[~worn] == Status.PREDICTED).all()


def test_a_rule_with_an_unknown_segment_is_refused(tmp_path):
    path = tmp_path / "body.yaml"
    path.write_text(
        "name: b\nsegments:\n"
        "  - {name: a, parent: null, tip: [0, 0, 1]}\n"
        "  - {name: b, parent: a, tip: [0, 0, 1], interpolate: {between: [a, c], fraction: 0.5}}\n"
    )
    with pytest.raises(SettingsError, match="'b' is interpolated from 'c', which is no other segment"):
        load_body(str(path))
