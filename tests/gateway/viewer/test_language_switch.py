"""What is chosen on a tab stays chosen when the page speaks another language."""

from __future__ import annotations

import asyncio

import pytest

viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

from gateway.viewer.body_steps import BodySteps  # noqa: E402 - needs the extra
from gateway.viewer.check_tab import CheckTab  # noqa: E402


@pytest.fixture
async def place():
    """What a tab is built with: server, tabs, a gateway that answers nothing, and the loop."""

    async def ask(_family, _verb, _data):
        return {}

    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server, server.gui.add_tab_group(), ask, asyncio.get_running_loop()
    server.stop()


async def test_a_step_stays_chosen(place):
    tab = BodySteps(*place)
    tab._take_steps([{"step": step, "instruction": ""} for step in ("n_pose", "t_pose", "squat")])
    tab._step.value = "squat"
    tab.speak("de")
    assert tab._step.value == "Kniebeuge"
    assert "in die Knie" in tab._picture.content


async def test_a_movement_stays_chosen(place):
    tab = CheckTab(*place, lambda: ())
    tab._movement.value = "bow"
    tab.speak("de")
    assert tab._movement.value == "Verbeugung"
