"""The page against the rules of axe-core: nothing serious, on any tab, in the dark and in the light."""

from __future__ import annotations

from importlib import resources

import aiomqtt
import pytest

from gateway.body.rig import load_rig
from gateway.contract.messages import BridgeState, describe_body
from gateway.contract.topics import Topics
from gateway.outputs.settings import MqttSettings
from tests.shown_page import SIZES, browser_of, new_page, open_tab, page_of
from tests.suit_service import GATEWAY

pytest.importorskip("axe_playwright_python", reason="axe-playwright-python is not installed")

pytestmark = pytest.mark.system
AXE = (resources.files("axe_playwright_python") / "axe.min.js").read_text(encoding="utf-8")
TABS = ("View", "Plot", "Modules", "1–3 Suit", "4 Sensors", "5 Body", "6 Check", "7 Takes")
GRAVE = {"serious", "critical"}
LIBRARY = "'.mantine-Notification-root', '.mantine-ActionIcon-root'"
"""What the page's library adds by itself, whose buttons have no names: its remark that there is no graphics
processor, and the panel's settings."""
RUN = f"axe.run({{exclude: [{LIBRARY}]}}, {{resultTypes: ['violations']}})"


@pytest.mark.parametrize("size", SIZES, ids=["desktop", "phone"])
async def test_axe_finds_nothing_serious_on_any_tab(mosquitto, unused_port, chromium, size):
    topics = Topics("mocap", GATEWAY)
    async with aiomqtt.Client("127.0.0.1", mosquitto.port) as client:
        await client.publish(topics.bridge_state, BridgeState(state="online").payload(), retain=True)
        await client.publish(topics.body, describe_body(load_rig("suit_17").skeleton).payload(), retain=True)
        async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium, size) as (page, _):
            await page.get_by_text(f"{GATEWAY}: online").wait_for()
            await page.evaluate(AXE)
            found = await grave_on(page, TABS)
            assert not found, "\n".join(found)
            await open_tab(page, "View")
            await page.get_by_role("checkbox", name="Light").click()
            await page.locator("[data-mantine-color-scheme=light]").first.wait_for()
            found = await grave_on(page, ("View", "Modules", "5 Body", "7 Takes"))
            assert not found, "\n".join(found)


async def grave_on(page, tabs):
    """What breaks a rule gravely, by tab."""
    found = []
    for tab in tabs:
        await open_tab(page, tab)
        for one in (await page.evaluate(RUN))["violations"]:
            if one["impact"] in GRAVE:
                found += [
                    f"{tab}: {one['id']}: {node['html'][:160]} {node['failureSummary']}"
                    for node in one["nodes"]
                ]
    return found


async def test_a_page_with_a_button_without_a_name_is_found(chromium):
    """The check can fail."""
    async with browser_of(chromium) as browser:
        page = await new_page(browser)
        await page.set_content("<main><button role='tab'></button><button></button></main>")
        await page.evaluate(AXE)
        names = [one["id"] for one in (await page.evaluate(RUN))["violations"] if one["impact"] in GRAVE]
        assert "button-name" in names
