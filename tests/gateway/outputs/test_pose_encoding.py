"""Pose bytes against the model that documents them."""

from __future__ import annotations

import numpy as np
import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.contract.messages import PoseMessage
from gateway.frames import SkeletonFrame, Status
from gateway.outputs.pose_encoding import PoseEncoder, as_json
from gateway.outputs.settings import PoseMap

NAMES = ("pelvis", "left_thigh", "left_shank")
EVERYTHING = frozenset(PoseMap)

numbers = st.one_of(
    st.floats(-1e6, 1e6), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, 5e-324, -0.0])
)


def skeleton_frame(seed: int = 0, n: int = len(NAMES)) -> SkeletonFrame:
    rng = np.random.default_rng(seed)
    q_wb = rng.normal(size=(n, 4))
    q_wb /= np.linalg.norm(q_wb, axis=1, keepdims=True)
    return SkeletonFrame(
        sequence=41,
        time_ns=1_700_000_000_123_456_789,
        q_wb=q_wb,
        angular_rate=rng.normal(size=(n, 3)),
        joint_acceleration=rng.normal(size=(n, 3)),
        p_w=rng.normal(size=(n, 3)),
        sigma=rng.uniform(size=n),
        status=np.arange(n, dtype=np.uint8),
        root=1,
    )


def test_pose_reads_as_the_contract_says() -> None:
    frame = skeleton_frame()
    frame.q_wb[:] = [[1, 0, 0, 0], [0.5, 0.5, -0.5, 0.5], [np.nan] * 4]
    assert orjson.loads(PoseEncoder(NAMES).encode(frame)) == {
        "t_ns": 1_700_000_000_123_456_789,
        "seq": 41,
        "frame": "ENU",
        "order": "wxyz",
        "root": "left_thigh",
        "segments": {"pelvis": [1, 0, 0, 0], "left_thigh": [0.5, 0.5, -0.5, 0.5], "left_shank": None},
        "status": {"pelvis": "measured", "left_thigh": "interpolated", "left_shank": "held"},
    }


@pytest.mark.parametrize(("decimals", "tolerance"), [(None, 0.0), (6, 5e-7), (2, 5e-3)])
def test_model_reads_back_every_value(decimals: int | None, tolerance: float) -> None:
    frame = skeleton_frame(3)
    pose = PoseMessage.model_validate_json(PoseEncoder(NAMES, decimals, EVERYTHING).encode(frame))
    for published, values in (
        (pose.segments, frame.q_wb),
        (pose.position, frame.p_w),
        (pose.acceleration, frame.joint_acceleration),
        (pose.angular_rate, frame.angular_rate),
        (pose.sigma, frame.sigma),
    ):
        assert published is not None
        assert tuple(published) == NAMES
        np.testing.assert_allclose(list(published.values()), values, rtol=0, atol=tolerance + 1e-15)


@given(
    values=st.lists(numbers, min_size=42, max_size=42),
    status=st.lists(st.sampled_from(Status), min_size=3, max_size=3),
    decimals=st.sampled_from([None, 0, 6]),
)
def test_whatever_is_in_a_frame_the_message_is_valid(
    values: list[float], status: list[Status], decimals: int | None
) -> None:
    q_wb, angular_rate, acceleration, p_w, sigma = np.split(np.array(values), [12, 21, 30, 39])
    frame = SkeletonFrame(
        sequence=0,
        time_ns=0,
        q_wb=q_wb.reshape(3, 4),
        angular_rate=angular_rate.reshape(3, 3),
        joint_acceleration=acceleration.reshape(3, 3),
        p_w=p_w.reshape(3, 3),
        sigma=sigma,
        status=np.array(status, dtype=np.uint8),
        root=0,
    )
    encoder = PoseEncoder(NAMES, decimals, EVERYTHING)
    assert encoder.encode(frame) == as_json(encoder.message(frame))
    pose = PoseMessage.model_validate_json(encoder.encode(frame))
    defined = [row is not None for row in pose.segments.values()]
    assert defined == np.isfinite(frame.q_wb).all(axis=1).tolist()
    assert pose.sigma is not None
    assert [value is not None for value in pose.sigma.values()] == np.isfinite(sigma).tolist()
    assert list(pose.status.values()) == [value.name.lower() for value in status]


@given(
    values=st.lists(st.floats(-1e9, 1e9), min_size=42, max_size=42),
    small=st.sampled_from([1.0, 1e-6, 1e-9]),
    status=st.lists(st.sampled_from(Status), min_size=3, max_size=3),
    decimals=st.sampled_from([None, 0, 3, 6]),
    root=st.sampled_from([0, 2]),
    include=st.sets(st.sampled_from(sorted(EVERYTHING))),
)
def test_a_pose_is_written_as_its_fields_are(
    values: list[float],
    small: float,
    status: list[Status],
    decimals: int | None,
    root: int,
    include: set[PoseMap],
) -> None:
    names = ("pelvis", 'left "100 %d" thigh', "Wirbelsäule")
    q_wb, angular_rate, acceleration, p_w, sigma = np.split(np.array(values) * small, [12, 21, 30, 39])
    frame = SkeletonFrame(
        sequence=2**40,
        time_ns=-1,
        q_wb=q_wb.reshape(3, 4),
        angular_rate=angular_rate.reshape(3, 3),
        joint_acceleration=acceleration.reshape(3, 3),
        p_w=p_w.reshape(3, 3),
        sigma=sigma,
        status=np.array(status, dtype=np.uint8),
        root=root,
    )
    encoder = PoseEncoder(names, decimals, include)
    for _ in range(2):  # the second from what was kept
        assert encoder.encode(frame) == as_json(encoder.message(frame))


def test_status_follows_the_frame_although_it_is_kept_encoded() -> None:
    encoder = PoseEncoder(NAMES)
    frame = skeleton_frame()
    seen = []
    for value in (Status.MEASURED, Status.MEASURED, Status.MISSING, Status.WARMING_UP):
        frame.status[:] = value
        seen.append(orjson.loads(encoder.encode(frame))["status"]["left_shank"])
    assert seen == ["measured", "measured", "missing", "warming_up"]


def test_frame_of_another_skeleton_is_an_error() -> None:
    with pytest.raises(ValueError, match="zip"):
        PoseEncoder(NAMES).encode(skeleton_frame(n=4))
