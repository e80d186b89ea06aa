"""Notes on motions that an analysis can say little about."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco")

from gateway.analysis.analysing import analyse
from gateway.analysis.inertia_file import load_inertia
from gateway.body.body_file import load_body
from gateway.body.inertia import body_inertia
from gateway.errors import GatewayError
from gateway.frames import Status
from gateway.recording import SkeletonArrays

GRAVITY = np.array([0.0, 0.0, -9.81])


def standing(name="human_17", frames=60, fall=0.0, swing=0.0, root=(0.0, 0.0, 0.93)):
    """At 100 Hz. fall: m/s² downwards. swing: rad of the left thigh forward and back."""
    body = load_body(name)
    time_s = np.arange(frames) * 0.01
    q_wb = np.tile(body.neutral, (frames, body.n_segments, 1))
    for part in ("left_thigh", "left_shank", "left_foot") if swing else ():
        turn = Rotation.from_rotvec(np.outer(swing * np.sin(6 * time_s), [0, 0, 1]))
        upright = Rotation.from_quat(body.neutral, scalar_first=True)
        q_wb[:, body.index(part)] = (upright * turn).as_quat(scalar_first=True)
    p_w = np.full((frames, body.n_segments, 3), np.nan)
    p_w[:, 0] = root
    p_w[:, 0, 2] -= 0.5 * fall * time_s**2
    zero = np.zeros((frames, body.n_segments, 3))
    return SkeletonArrays(
        np.arange(frames) * 10_000_000, np.arange(frames), q_wb, p_w, zero, zero, zero[..., 0],
        np.full(zero.shape[:2], Status.MEASURED, dtype=np.uint8), body,
    )  # fmt: skip


def notes(arrays, kg=70.0):
    found = analyse(arrays, "x", body_inertia(arrays.skeleton, kg), GRAVITY, None)
    return " ".join(found.notes)


def test_standing_still_has_nothing_to_be_told():
    told = notes(standing())
    assert "estimated in 100 %" in told
    assert "trust" not in told
    assert "stays at one point" not in told


def test_a_root_that_hangs_while_the_legs_swing_is_told():
    assert "its path was not recorded" in notes(standing(swing=0.6, root=(np.nan,) * 3))


def test_what_the_floor_cannot_explain_is_told():
    """Faster down than free fall: a floor only pushes."""
    told = notes(standing(fall=15.0))
    assert "do not trust torques" in told
    assert "in 100 % of the frames" in told


def test_legs_alone_without_plates_hang_in_the_air():
    told = notes(standing("lower_body_7"))
    assert "hang in the air" in told
    assert "do not trust" not in told


@pytest.mark.parametrize(("frames", "is_long_enough"), [(33, False), (40, True)])
def test_two_periods_of_the_cut_off_are_wanted(frames, is_long_enough):
    arrays = standing(frames=frames)
    weighed = body_inertia(arrays.skeleton, 70.0)
    if is_long_enough:
        assert len(analyse(arrays, "x", weighed, GRAVITY, 6.0).time_s) == frames
        return
    with pytest.raises(GatewayError, match=r"0.32 s of motion is too short .* 6 Hz: 0.333 s at least"):
        analyse(arrays, "x", weighed, GRAVITY, 6.0)
    with pytest.raises(GatewayError, match=r"a cut-off of 1e-300 Hz: 2e\+300 s at least"):
        analyse(arrays, "x", weighed, GRAVITY, 1e-300)


def test_a_chain_of_links_is_analysed_without_a_floor(tmp_path):
    (tmp_path / "chain.yaml").write_text(
        "segments:\n"
        "  segment_3: {mass_kg: 0.3, centre_m: [0.1, 0, 0], inertia_kg_m2: [1.e-4, 1.e-3, 1.e-3]}\n"
    )
    arrays = standing("chain_5")
    found = analyse(arrays, "x", load_inertia(tmp_path / "chain.yaml", arrays.skeleton), GRAVITY, None)
    assert found.dynamics.residual_force[:, 2] == pytest.approx(0.3 * 9.81, rel=1e-3)
    assert not found.floor.source.size
    assert "trust" not in " ".join(found.notes)
