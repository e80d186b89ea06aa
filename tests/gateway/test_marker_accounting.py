"""The balance of frames with an optical link: every message that was read is one pose, and no other is."""

from __future__ import annotations

import numpy as np
import orjson
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from devices.link import Chunk
from gateway.body.body_file import WorldSettings, load_body, worn_without_modules
from gateway.body.skeleton import BodyMarkers
from gateway.contract.balances import unaccounted
from gateway.pipeline import LOAD_EVENT, Pipeline
from gateway.reconstruction import OPTICAL
from gateway.service.accounting import balances_of
from gateway.stages.frame_assembler import AssemblyParams

BODY = load_body("human_17")
LABELS = ("a", "b", "c", "d")
MARKERS = BodyMarkers(LABELS, np.zeros(4, np.int64), 0.1 * np.eye(4, 3), np.full(4, 0.004))
SUIT = worn_without_modules(BODY, MARKERS, WorldSettings())

GOOD = st.builds(
    lambda seen: {
        "markers": {label: [0.1 * k, 0.2, 0.3] if k < seen else None for k, label in enumerate(LABELS)}
    },
    st.integers(0, 2),
)
"""Too few markers for a pose: held or missing, and counted all the same."""
BAD = st.sampled_from(
    [
        {"markers": 3},
        {"markers": {"a": [1, 2]}},
        {"markers": {"a": [0, 0, 0]}, "unit": "ell"},
        {"markers": {}, "time_ns": -1},
        ["no", "message"],
    ]
)


def _gateway() -> Pipeline:
    made = Pipeline(SUIT, AssemblyParams(1e7, max_wait_ns=0, max_gap_ns=0, hold_ns=0), OPTICAL)
    for name in ("left", "right"):
        made.add_link(name, "markers")
    return made


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.tuples(st.sampled_from(["left", "right"]), st.one_of(GOOD, BAD)), max_size=30))
def test_messages_of_two_links_good_and_bad_leave_nothing_over(messages):
    gateway, poses = _gateway(), 0
    gateway.event(LOAD_EVENT, {"solve_every": 4})  # what is given up in overload is the inertial frames
    for k, (link, content) in enumerate(messages):
        poses += len(gateway.feed(Chunk(orjson.dumps(content) + b"\n", 10**9 + k * 10**7, link)))
        assert unaccounted(balances_of(gateway)) == {}
    readable = sum("time_ns" not in content and _is_good(content) for _, content in messages)
    frames = next(each for each in balances_of(gateway) if each.name == "frames")
    assert (frames.total, frames.parts["reconstructed"], frames.parts["left_out"]) == (readable, poses, 0)
    assert poses == readable
    dropped = gateway.statistics()["markers"]["dropped"]
    assert sum(dropped.values()) == len(messages) - readable


def test_a_pose_that_goes_astray_shows():
    gateway = _gateway()
    gateway.feed(Chunk(orjson.dumps({"markers": {"a": [0, 0, 0]}}), 10**9, "left"))
    gateway.skeleton_frames -= 1
    assert unaccounted(balances_of(gateway)) == {"frames": 1}


def _is_good(content: object) -> bool:
    places = content.get("markers") if isinstance(content, dict) else None
    return (
        isinstance(places, dict)
        and all(place is None or len(place) == 3 for place in places.values())
        and "unit" not in content
    )
