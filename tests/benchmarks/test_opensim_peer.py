"""The yardstick itself: a pose that is known comes back from OpenSim, and a wrong interpreter is named."""

import numpy as np
import pytest

from benchmarks import opensim_peer
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.geometry import quaternion


def arm() -> tuple[Skeleton, BodyMarkers]:
    skeleton = Skeleton(
        "arm", ("upper", "lower"), np.array([-1, 0]), np.array([[0.0, 0, 0], [0, -0.3, 0]]),
        np.array([[0.0, -0.3, 0], [0, -0.25, 0]]),
    )  # fmt: skip
    places = np.array([[0.0, 0, 0], [0, -0.3, 0], [0.1, -0.1, 0], [0, 0, 0], [0, -0.2, 0.0], [0, -0.1, 0.1]])
    markers = BodyMarkers(tuple("abcdef"), np.repeat([0, 1], 3), places, np.full(6, 0.01))
    return skeleton, markers


def test_an_interpreter_that_is_none_is_named(monkeypatch):
    monkeypatch.setenv(opensim_peer.VARIABLE, "/nowhere/python")
    with pytest.raises(opensim_peer.OpenSimMissingError, match="MOCAP_OPENSIM=/nowhere/python: not a Python"):
        opensim_peer.interpreter()


def test_a_known_pose_comes_back():
    try:
        opensim_peer.interpreter()
    except opensim_peer.OpenSimMissingError as missing:
        pytest.skip(str(missing))
    skeleton, markers = arm()
    turns = np.array([[0.9, 0.1, 0.3, -0.2], [0.8, -0.4, 0.2, 0.3]])
    R = np.array([quaternion.to_matrix(turn / np.linalg.norm(turn)) for turn in turns])
    p = np.array([[0.5, 0.2, 1.0], [0.5, 0.2, 1.0] + R[0] @ skeleton.offsets[1]])
    seen = p[markers.segments] + np.einsum("mij,mj->mi", R[markers.segments], markers.positions)
    found = opensim_peer.solve(skeleton, markers, np.tile(seen, (3, 1, 1)), 100.0)
    np.testing.assert_allclose(found.R[-1], R, atol=1e-3)
    np.testing.assert_allclose(found.p_w[-1], p, atol=1e-3)
    assert found.rmse < 1e-4
