"""Bodies, poses and names that somebody else published: the page goes on, and no terminal obeys it."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
from types import SimpleNamespace

import aiomqtt
import pytest
from pydantic import ValidationError
from rich.console import Console

from gateway.body.rig import load_rig
from gateway.cli.watch import Watch, watch_poses
from gateway.contract.messages import BodyMessage, PoseMessage, describe_body
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber, ReceivedPose
from gateway.support.names import printable
from gateway.viewer.module_table import module_rows
from gateway.viewer.pose_table import PoseView, joint_table

SEGMENT = {"name": "a", "parent": None, "offset": [0, 0, 0], "tip": [0, 1, 0]}
HOSTILE_BODIES = {
    "no segment": [],
    "no root": [SEGMENT | {"parent": "a"}],
    "unknown parent": [SEGMENT, SEGMENT | {"name": "b", "parent": "c"}],
    "parent later": [SEGMENT, SEGMENT | {"name": "b", "parent": "c"}, SEGMENT | {"name": "c", "parent": "b"}],
    "its own parent": [SEGMENT, SEGMENT | {"name": "b", "parent": "b"}],
    "two roots": [SEGMENT, SEGMENT | {"name": "b"}],
    "twice": [SEGMENT, SEGMENT | {"parent": "a"}],
    "far away": [SEGMENT | {"tip": [0, 1e300, 0]}],
}
ESCAPES = ["\x1b]0;owned\x07", "\x1b[2J", "\x9b31m", "\u202egnp", "\x00", "\x7f", "\r\n"]
OBEYED = frozenset("\x1b\x07\x9b\u202e\x00\x7f\r")


def pose_of(*names):
    pose = PoseMessage(
        t_ns=2**63 - 1,
        seq=1,
        frame="ENU",
        order="wxyz",
        root=names[0],
        segments=dict.fromkeys(names, (1e308, 1e308, 1e308, 1e308)),
        status=dict.fromkeys(names, "measured"),
        joint_angles={name: {name: 1.0} for name in names},
        joint_warnings=dict.fromkeys(names, ("beyond_limits",)),
    )
    return ReceivedPose("lab", 10**18, pose, b"{}")


@pytest.mark.parametrize("segments", HOSTILE_BODIES.values(), ids=HOSTILE_BODIES)
def test_a_body_that_is_no_tree_is_refused(segments):
    with pytest.raises(ValidationError):
        BodyMessage.model_validate({"name": "x", "segments": segments})


async def test_hostile_retained_bodies_do_not_end_the_page(mosquitto, until):
    viser = pytest.importorskip("viser")
    from gateway.viewer.live import LiveViewer  # noqa: PLC0415 - needs the extra

    mosquitto.is_for_gateways_only = False
    settings = MqttSettings(port=mosquitto.port)
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    viewer = LiveViewer(server, settings, "lab")
    good = describe_body(load_rig("single").skeleton)
    async with aiomqtt.Client("127.0.0.1", mosquitto.port) as client, PoseSubscriber(settings) as poses:
        showing = asyncio.create_task(viewer.run())
        for number, segments in enumerate(HOSTILE_BODIES.values()):
            body = json.dumps({"name": "x", "segments": segments})
            await client.publish("mocap/lab/body", body, qos=1, retain=True)
            await until(lambda number=number: poses.undecodable == number + 1 or showing.done())
        await client.publish("mocap/lab/body", good.payload(), qos=1, retain=True)
        await until(lambda: viewer._message == good or showing.done())
        assert not showing.done()
        showing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await showing
    server.stop()


def test_figures_beyond_all_measure_are_shown_all_the_same():
    summary = {"received": 10**400, "lost": -(10**400), "clock_ppm": 10**400, "residual_us": 1}
    health = SimpleNamespace(statistics={"modules": {"1": summary}})
    assert len(module_rows(health, None)) == 1


def test_an_instant_that_no_clock_tells_is_refused():
    plain = pose_of("a").pose.model_dump()
    for key in ("t_ns", "seq"):
        for value in (10**400, 2**63, -(2**63) - 1):
            with pytest.raises(ValidationError, match="64 bits"):
                PoseMessage.model_validate(plain | {key: value})


@pytest.mark.parametrize("escape", ESCAPES, ids=ascii)
def test_names_are_not_obeyed_by_the_terminal(escape):
    name = f"a{escape}[/red]"
    view = PoseView(name)
    view.add(pose_of(name))
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=200, color_system=None)
    for with_quaternions in (False, True):
        console.print(view.table(10**18, "online", with_quaternions))
    console.print(joint_table(view.last.pose))
    assert not OBEYED & set(shown.getvalue())
    assert "[/red]" in shown.getvalue()


def test_text_that_harms_nobody_stays_as_it_is():
    assert printable("Brustbein ä ✓ 胸") == "Brustbein ä ✓ 胸"


async def test_the_line_that_nothing_came_obeys_no_name(mosquitto, capsys):
    mosquitto.is_for_gateways_only = False
    async with aiomqtt.Client("127.0.0.1", mosquitto.port) as client:
        await client.publish("mocap/bad\u202e2J/bridge/state", '{"state": "online"}', qos=1, retain=True)
    settings, wanted = MqttSettings(port=mosquitto.port), Watch(count=1, timeout=0.5)
    assert await watch_poses(settings, wanted, Console(file=io.StringIO())) == 1
    assert not OBEYED & set(capsys.readouterr().err)


def test_the_bodies_that_gateways_publish_are_trees():
    for rig in ("suit_17", "robot_arm_4", "single", "suit_23_from_17"):
        assert BodyMessage.model_validate_json(describe_body(load_rig(rig).skeleton).payload())
