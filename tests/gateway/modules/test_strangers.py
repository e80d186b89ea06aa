"""Who is heard and not in the rig is told once, with what to do."""

from __future__ import annotations

from types import SimpleNamespace

from firmware_protocol import RELAY
from gateway.body.rig import load_rig
from gateway.modules.module_log import UnknownModules


def heard(unique_id=None):
    return SimpleNamespace(info=None if unique_id is None else SimpleNamespace(unique_id=unique_id))


def test_strangers_are_told_once_with_those_of_the_rig_that_are_missing():
    stream = SimpleNamespace(modules={RELAY: heard(), 0: heard()})
    unknown = UnknownModules(stream, load_rig("robot_arm_4"))
    assert unknown.news() is None
    stream.modules |= {9: heard(b"a" * 12), 7: heard()}
    assert unknown.news() == (
        "heard, but not in the rig: module 7, 9 (unique id 616161616161616161616161); of the rig, not heard: "
        "1 (link_2), 2 (link_3), 3 (link_4). Nothing is made of what they send: add them to the rig file, or "
        "give them its ids (mocap-gateway modules assign --allow-writes)"
    )
    assert unknown.news() is None
    stream.modules[3] = heard()
    assert (unknown.news(), unknown.known) == (None, 2)
    stream.modules[8] = heard()
    assert "module 7, 8, 9 (" in unknown.news()


def test_what_a_stream_sends_besides_is_nobody_strange():
    stream = SimpleNamespace(modules={0: heard(), 9: heard()})
    assert UnknownModules(stream, load_rig("robot_arm_4"), unworn=(8, 9)).news() is None
