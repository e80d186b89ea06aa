"""Topics, and which of them belong to a gateway."""

from __future__ import annotations

import pytest

from gateway.contract.messages import PUBLICATIONS
from gateway.contract.topics import ANY_GATEWAY, Topics


def test_topics_are_those_of_the_contract() -> None:
    topics = Topics("mocap", "lab")
    named = {topics.bridge_state, topics.bridge_info, topics.bridge_health, topics.body, topics.pose}
    assert named == {
        "mocap/lab/bridge/state",
        "mocap/lab/bridge/info",
        "mocap/lab/bridge/health",
        "mocap/lab/body",
        "mocap/lab/pose",
    }
    named |= {topics.module_state(7), topics.module_availability(7)}
    assert {"mocap/lab/module/7/state", "mocap/lab/module/7/availability"} <= named
    named |= {topics.pose_msgpack, topics.segment("left_hand")}
    assert {"mocap/lab/pose/msgpack", "mocap/lab/segment/left_hand"} <= named
    named |= {topics.comparison, topics.markers}
    named |= {topics.predicted_pose, topics.predicted_pose_msgpack}
    assert {"mocap/lab/pose/predicted", "mocap/lab/pose/predicted/msgpack"} <= named
    named |= {topics.robot, topics.late_pose, f"{topics.bridge_echo}/7"}
    assert "mocap/lab/robot/joint_states" in named
    assert named == {f"{topics.root}/{each.topic.format(id=7, name='left_hand')}" for each in PUBLICATIONS}


@pytest.mark.parametrize("name", ["", "a/b", "a+", "#", "a\0"])
def test_gateway_name_is_one_topic_level(name: str) -> None:
    with pytest.raises(ValueError, match="gateway name"):
        Topics("mocap", name)


@pytest.mark.parametrize(
    ("gateway", "topic", "expected"),
    [
        ("lab", "mocap/lab/pose", ("lab", "pose")),
        ("lab", "mocap/lab/bridge/state", ("lab", "bridge/state")),
        (ANY_GATEWAY, "mocap/hall/pose", ("hall", "pose")),
        ("lab", "mocap/hall/pose", None),
        ("lab", "mocap/lab", None),
        ("lab", "mocap/laboratory/pose", None),
        (ANY_GATEWAY, "mocapx/lab/pose", None),
        (ANY_GATEWAY, "other/mocap/lab/pose", None),
        (ANY_GATEWAY, "ret/kept", None),
    ],
)
def test_split_tells_own_topics_from_others(
    gateway: str, topic: str, expected: tuple[str, str] | None
) -> None:
    assert Topics("mocap", gateway).split(topic) == expected


def test_base_topic_may_have_several_levels() -> None:
    assert Topics("site/3/mocap", "lab").split("site/3/mocap/lab/pose") == ("lab", "pose")
