"""Re-rooting: the same joints, seen from another segment."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.body.skeleton import Skeleton
from gateway.reconstruction.inertial.travel import travel_from

#      0 ── 1 ── 2
#      └─── 3 ── 4
#           └─── 5
PARENTS = np.array([-1, 0, 1, 0, 3, 3])


def skeleton():
    offsets = np.random.default_rng(3).normal(size=(6, 3))
    offsets[0] = 0.0
    return Skeleton("tree", tuple("abcdef"), PARENTS, offsets, np.zeros((6, 3)))


@pytest.mark.parametrize(
    ("root", "entered_from"),
    [(0, [-1, 0, 1, 0, 3, 3]), (2, [1, 2, -1, 0, 3, 3]), (3, [3, 0, 1, -1, 3, 3]), (5, [3, 0, 1, 5, 3, -1])],
)
def test_every_segment_comes_after_the_one_it_is_entered_from(root, entered_from):
    travel = travel_from(skeleton(), root, np.zeros(3))
    np.testing.assert_array_equal(travel.entered_from, entered_from)
    assert sorted(travel.order) == list(range(6))
    place = np.argsort(travel.order)
    assert all(place[s] > place[entered_from[s]] for s in range(6) if s != root)


@pytest.mark.parametrize("root", range(6))
def test_all_joints_lie_where_they_lay_whatever_the_root(root):
    rng = np.random.default_rng(8)
    body, R, point = skeleton(), Rotation.random(6, rng=rng), rng.normal(size=3)
    proximal = np.zeros((6, 3))
    for s in range(1, 6):
        proximal[s] = proximal[PARENTS[s]] + R[PARENTS[s]].apply(body.offsets[s])

    travel = travel_from(body, root, point)
    P = np.zeros((6, 3))
    for s in travel.order:
        n = travel.entered_from[s]
        P[s] = proximal[root] + R[root].apply(point) if n < 0 else P[n] + R[n].apply(travel.link[s])
    np.testing.assert_allclose(P + R.apply(travel.proximal), proximal, atol=1e-13)

    lever_arms = rng.normal(size=(6, 3))
    modules = P + R.apply(travel.arms(lever_arms))
    np.testing.assert_allclose(modules, proximal + R.apply(lever_arms), atol=1e-13)


def test_a_segment_entered_at_its_proximal_joint_keeps_its_lever_arm_exactly():
    travel = travel_from(skeleton(), 0, np.zeros(3))
    lever_arms = np.random.default_rng(1).normal(size=(6, 3))
    np.testing.assert_array_equal(travel.arms(lever_arms), lever_arms)
