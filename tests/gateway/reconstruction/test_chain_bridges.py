"""Segments without module within a chain: the joint in their place, against the body's own geometry."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.body.interpolation import follow, following_rules
from gateway.body.kinematics import joint_positions
from gateway.body.rig import load_rig
from gateway.reconstruction.inertial.tree.state import bridges_of, chain_body
from gateway.reconstruction.inertial.tree.tuning import tuning


@pytest.fixture(scope="module")
def suit():
    return load_rig("suit_23_from_17")


def test_with_a_module_on_every_segment_nothing_is_bridged():
    suit = load_rig("suit_17")
    bridges = bridges_of(suit, tuning())
    assert not bridges.is_bridged.any()
    assert not bridges.beyond.any()
    assert not bridges.slack.any()
    np.testing.assert_array_equal(bridges.parents, suit.skeleton.parents)
    np.testing.assert_array_equal(bridges.before, suit.skeleton.offsets)


def test_thorax_and_head_are_joined_over_spine_and_neck(suit):
    skeleton, bridges = suit.skeleton, bridges_of(suit, tuning())
    thorax, head = skeleton.index("thorax"), skeleton.index("head")
    assert skeleton.segment_names[bridges.parents[thorax]] == "pelvis"
    assert skeleton.segment_names[bridges.parents[head]] == "thorax"
    assert set(np.flatnonzero(bridges.is_bridged)) == {thorax, head}
    assert all(bridges.parents[suit.module_of_segment < 0] == -1)
    assert sum(chain_body(suit, True).segments["parent"] < 0) == 1 + np.sum(suit.module_of_segment < 0)


def test_the_joint_in_their_place_is_where_the_body_has_it(suit):
    """To first order in the bend, and well within ``slack`` for a bend of 30°."""
    skeleton, bridges = suit.skeleton, bridges_of(suit, tuning())
    pelvis, thorax = skeleton.index("pelvis"), skeleton.index("thorax")
    upright = Rotation.from_rotvec([0.1, -0.2, 0.7])
    for bend in (0.05, 0.52):
        q_wb = np.tile(upright.as_quat(scalar_first=True), (skeleton.n_segments, 1))
        bent = upright * Rotation.from_rotvec([0.0, 0.3 * bend, bend])
        q_wb[thorax] = bent.as_quat(scalar_first=True)
        zeros = np.zeros((skeleton.n_segments, 3))
        status = np.zeros(skeleton.n_segments, np.uint8)
        follow(following_rules(suit), q_wb, zeros, zeros[:, 0].copy(), status)
        p = joint_positions(skeleton.parents.astype(np.int64), skeleton.offsets, q_wb, np.zeros(3))
        placed = p[pelvis] + upright.apply(bridges.before[thorax]) + bent.apply(bridges.beyond[thorax])
        off = np.linalg.norm(placed - p[thorax])
        assert off < 0.1 * bend**2
        assert off < bridges.slack[thorax]


def test_without_a_rule_a_segment_goes_with_its_parent(suit):
    skeleton = replace(suit.skeleton, interpolations=())
    bridges = bridges_of(replace(suit, skeleton=skeleton), tuning())
    thorax = skeleton.index("thorax")
    assert not bridges.beyond.any()
    np.testing.assert_allclose(bridges.before[thorax], [0.0, 0.30, 0.0])
    assert bridges.slack[thorax] > bridges_of(suit, tuning()).slack[thorax]
