"""What became of markers, as published and as recorded."""

from __future__ import annotations

import math

import numpy as np
import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.body.body_file import load_body
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import MarkersMessage
from gateway.contract.topics import Topics
from gateway.frames import MarkerFit, SkeletonFrame, Status
from gateway.geometry import quaternion
from gateway.outputs.pose_encoding import PosePublications, markers_message
from gateway.outputs.settings import MqttSettings
from gateway.reconstruction.resets import Resets
from gateway.recording.pose_encoding import decode_markers, encode_markers_of

BODY = load_body("human_17")
LABELS = ("LASI", "RASI", "SACR")
FIT = MarkerFit(
    positions=np.array([[0.1, 0.2, 0.9], [np.nan] * 3, [0.0, -0.1, 0.95]]),
    virtual=np.array([[0.1, 0.2, 0.902], [0.1, 0.0, 0.9], [0.0, 0.0, 0.95]]),
    residuals=np.array([0.002, np.nan, 0.1]),
    used=np.array([True, False, False]),
    renamed=((0, 2), (2, -1)),
    unlabelled=np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]]),
)


def frame(number: int = 0, fit: MarkerFit | None = FIT, body: Skeleton = BODY) -> SkeletonFrame:
    n = body.n_segments
    return SkeletonFrame(
        number, number * 10_000_000, np.tile(body.neutral, (n, 1)), np.zeros((n, 3)), np.zeros((n, 3)),
        np.tile([0.5, 0.0, 0.9], (n, 1)), np.full(n, np.nan), np.full(n, Status.MEASURED, np.uint8), 0, fit,
    )  # fmt: skip


def test_a_message_tells_of_every_marker():
    told = MarkersMessage.model_validate_json(orjson.dumps(markers_message(LABELS, frame(7))))
    assert (told.seq, told.t_ns) == (7, 70_000_000)
    left, right, sacrum = (told.markers[label] for label in LABELS)
    assert (left.position, left.residual, left.used, left.taken_from) == (
        (0.1, 0.2, 0.9),
        0.002,
        True,
        "SACR",
    )
    assert (right.position, right.residual, right.used, right.taken_from) == (None, None, False, None)
    assert (sacrum.used, sacrum.taken_from, sacrum.expected) == (False, "", (0.0, 0.0, 0.95))
    assert told.unlabelled == ((1.0, 2.0, 3.0),)


def test_no_message_of_a_pose_that_was_made_of_something_else():
    assert markers_message(LABELS, frame(0, None)) is None
    with pytest.raises(ValueError, match="zip"):
        markers_message((*LABELS, "C7"), frame())


@pytest.mark.parametrize(("rate", "expected"), [(30.0, 30), (100.0, 100), (None, 0)])
def test_they_are_published_at_their_own_rate_and_not_in_need(rate, expected):
    topics = Topics("mocap", "lab")
    publications = PosePublications(MqttSettings(marker_rate=rate), BODY, topics, LABELS)
    sent = [out.topic for k in range(100) for out in publications.of(frame(k))]
    assert sent.count(topics.pose) == 100
    assert sent.count(topics.markers) == pytest.approx(expected, abs=4)
    publications.has_segments = False
    assert [out.topic for out in publications.of(frame(200))] == [topics.pose]


def test_a_reset_of_the_heading_turns_them_with_the_body():
    resets = Resets(BODY)
    shown = resets.apply(frame(0))
    resets.reset("heading", math.pi / 2)
    shown = resets.apply(frame(300))
    turn = quaternion.to_matrix(quaternion.multiply(shown.q_wb[0], quaternion.conjugate(BODY.neutral)))
    pivot = np.array([0.5, 0.0, 0.9])
    np.testing.assert_allclose(shown.markers.virtual, pivot + (FIT.virtual - pivot) @ turn.T, atol=1e-9)
    apart = np.linalg.norm(shown.markers.positions - shown.markers.virtual, axis=1)
    np.testing.assert_allclose(apart[[0, 2]], FIT.residuals[[0, 2]], atol=1e-9)


@given(st.integers(0, 6), st.integers(0, 4), st.integers(0, 2**32 - 1))
def test_what_is_recorded_is_read_again(n, n_nameless, seed):
    generator = np.random.default_rng(seed)
    positions, virtual = (generator.normal(0.0, 2.0, (n, 3)).astype(np.float32) for _ in range(2))
    positions[generator.random(n) < 0.3] = np.nan
    used = np.isfinite(positions).all(axis=1)
    renamed = tuple((m, int(generator.integers(-1, n))) for m in range(n) if generator.random() < 0.3)
    renamed = tuple((m, whose) for m, whose in renamed if m != whose)
    nameless = generator.normal(0.0, 2.0, (n_nameless, 3)).astype(np.float32)
    residuals = np.linalg.norm(positions - virtual, axis=1)
    fit = MarkerFit(positions, virtual, residuals, used, renamed, nameless)
    data = encode_markers_of(-3, 2**60, fit)
    read = decode_markers(data)
    assert (read.sequence, read.time_ns, read.fit.renamed) == (-3, 2**60, renamed)
    for name in ("positions", "virtual", "used", "unlabelled"):
        np.testing.assert_array_equal(getattr(read.fit, name), getattr(fit, name))
    np.testing.assert_allclose(read.fit.residuals, residuals, atol=1e-6)
    for damaged in (data[:-1], data + b"\0", data[:10], b""):
        with pytest.raises(ValueError, match=r"markers|nameless"):
            decode_markers(damaged)
