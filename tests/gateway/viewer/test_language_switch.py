"""What is chosen on a tab stays chosen when the page speaks another language."""

from __future__ import annotations

import asyncio

import pytest

viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

from gateway.contract.messages import PoseMessage  # noqa: E402
from gateway.viewer.assistant import Assistant  # noqa: E402 - needs the extra
from gateway.viewer.body_steps import BodySteps  # noqa: E402
from gateway.viewer.check_tab import CheckTab  # noqa: E402
from gateway.viewer.panel import Panel  # noqa: E402
from gateway.viewer.sensor_tab import SensorTab  # noqa: E402
from gateway.viewer.stage import ViewerStage  # noqa: E402
from gateway.viewer.step_tab import _PLACE, Errands  # noqa: E402


@pytest.fixture
async def place():
    """What a tab is built with: server, tabs, and a gateway that answers nothing."""

    async def ask(_family, _verb, _data):
        return {}

    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server, server.gui.add_tab_group(), ask
    server.stop()


async def test_a_step_stays_chosen(place):
    tab = BodySteps(*place)
    tab._take_steps([{"step": step, "instruction": ""} for step in ("n_pose", "t_pose", "squat")])
    tab._step.value = "squat"
    tab.set_language("de")
    assert tab._step.value == "Kniebeuge"
    assert "in die Knie" in tab._picture.content


async def test_the_trail_is_named_after_the_root_whatever_it_is(place):
    server, *_ = place
    panel = Panel(server, (), ViewerStage(server))
    for root, named in (("base", "base"), ("pelvis", "Becken")):
        panel.name_root(root)
        assert panel.trail.label.endswith(f": {named}")
        panel.set_language("de")
        assert panel.trail.label == f"Spur: {named}"


async def test_a_step_changes_nothing_in_the_panel(place):
    """Poses of a body that walks start from the foot that stands; the list of plots may be open meanwhile."""
    server, *_ = place
    panel = Panel(server, (), ViewerStage(server))
    panel.name_root("pelvis")
    still = dict.fromkeys(("pelvis", "left_foot", "right_foot"), (1.0, 0.0, 0.0, 0.0))

    def standing_on(root):
        return PoseMessage(t_ns=1, seq=1, frame="ENU", order="wxyz", root=root, segments=still, status={})

    panel.add_pose(standing_on("left_foot"))
    label, options = panel.trail.label, panel._plotted.options
    panel.add_pose(standing_on("right_foot"))
    assert (label, panel.trail.label) == ("Trail: pelvis", "Trail: pelvis")
    assert panel._plotted.options is options


async def test_a_movement_stays_chosen(place):
    tab = CheckTab(*place, lambda: ())
    tab._movement.value = "bow"
    tab.set_language("de")
    assert tab._movement.value == "Verbeugung"


def answering(place, **answers):
    """The same place, with a gateway that answers by verb."""
    server, tabs, _ = place

    async def ask(_family, verb, _data):
        return answers[verb]

    return server, tabs, ask


LISTED = {
    "modules": [
        {
            "module": module,
            "unique_id": unique_id,
            "segment": segment,
            "answers": True,
            "battery_percent": 80,
            "rate_hz": 100.0,
            "loss_percent": 0.0,
            "clock": None,
        }
        for module, unique_id, segment in ((4, "a" * 24, "left_upper_arm"), (5, "b" * 24, "left_forearm"))
    ],
    "conflicts": [],
    "segments": {"left_upper_arm": 4, "left_forearm": 5},
}


async def test_a_module_and_a_segment_stay_chosen(place):
    server, tabs, ask = answering(place, list=LISTED)
    marked = []
    tab = Assistant(server, tabs, ask, marked.append)
    assert not tab._segment.visible, "what cannot be done yet is not shown"
    await pressed(tab._look)
    assert tab._segment.visible
    tab._device.value = "5 · left forearm · …bbbbbb"
    tab.choose_segment("left_upper_arm")
    assert tab._segment.value == "left upper arm"
    tab.set_language("de")
    assert tab._device.value == "5 · linker Unterarm · …bbbbbb"
    assert tab._segment.value == "linker Oberarm"
    assert "linker Unterarm" in tab._found.content
    assert (tab._chosen_device(), tab._chosen_segment()) == ("b" * 24, "left_upper_arm")


async def test_a_module_stays_chosen_that_has_another_id_now(place):
    server, tabs, ask = answering(place, list=LISTED)
    tab = Assistant(server, tabs, ask, lambda _segment: None)
    await pressed(tab._look)
    tab._device.value = "5 · left forearm · …bbbbbb"
    second = LISTED["modules"][1] | {"module": 4, "segment": "left_upper_arm"}
    tab._ask = answering(place, list=LISTED | {"modules": [second]})[2]
    await pressed(tab._look)
    assert tab._device.value == "4 · left upper arm · …bbbbbb"


STATUS = {
    "phase": "watching",
    "enough": True,
    "advice": "enough",
    "waited_for": [],
    "modules": [
        {
            "module": 5,
            "segment": "left_forearm",
            "enough": True,
            "heard": True,
            "rest_s": 3.0,
            "positions": 2,
            "wanted_positions": 9,
            "coverage": 0.5,
        }
    ],
}
FOUND = {"modules": {"5": {"gyroscope": {"quality": "good", "reasons": []}}}}


async def test_tables_of_the_sensors_speak_the_language_that_is_chosen(place):
    server, tabs, ask = answering(place, begin={}, status=STATUS, result=FOUND)
    tab = SensorTab(server, tabs, ask)
    await pressed(tab._begin)
    assert "left forearm" in tab._table.content
    tab.set_language("de")
    assert "linker Unterarm" in tab._table.content
    await pressed(tab._find)
    assert "Drehratensensor" in tab._table.content
    tab.set_language("en")
    assert "gyroscope" in tab._table.content


async def test_limbs_that_can_be_measured_have_names(place):
    measures = {"subject": {"height_m": 1.8}, "lengths": {"left_forearm": 0.25}}
    server, tabs, ask = answering(place, measure=measures)
    tab = BodySteps(server, tabs, ask)
    tab.set_language("de")
    await tab._take_measures()
    assert tab._length.options[1:] == ("linker Unterarm",)
    tab._length.value = "linker Unterarm"
    tab._show_length()
    assert tab._metres.value == 0.25


async def test_what_nobody_has_foreseen_is_told_in_the_language_that_is_chosen():
    told = asyncio.Queue()
    errands = Errands()
    errands.language = "de"

    async def fails():
        raise KeyError("x")

    errands.start(fails, told.put_nowait)
    assert "bitte melden" in await told.get()


async def pressed(action):
    """Do what a button does, as if another one had been pressed since."""
    _PLACE.set("nowhere")
    return await action()
