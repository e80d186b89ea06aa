"""The page against the rules of axe-core: nothing serious, on any tab, in any language, dark or light.

What the tabs show while a suit is set up is held against them in ``test_viewer_whole_way.py``.
"""

from __future__ import annotations

import aiomqtt
import pytest

from gateway.body.rig import load_rig
from gateway.contract.messages import BridgeState, describe_body
from gateway.contract.topics import Topics
from gateway.outputs.settings import MqttSettings
from gateway.viewer.texts import LANGUAGES, translated
from tests.accessible_page import grave_findings
from tests.shown_page import SIZES, browser_of, choose, new_page, open_tab, page_of
from tests.suit_service import GATEWAY

pytestmark = pytest.mark.system
TABS = ("view", "plot", "modules", "tab", "sensors", "body", "check", "takes")
"""Keys of their names in the texts."""


@pytest.mark.parametrize("size", SIZES, ids=["desktop", "phone"])
@pytest.mark.parametrize("shade", ["dark", "light"])
async def test_axe_finds_nothing_serious_on_any_tab(mosquitto, unused_port, chromium, size, shade):
    topics = Topics("mocap", GATEWAY)
    async with aiomqtt.Client("127.0.0.1", mosquitto.port) as client:
        await client.publish(topics.bridge_state, BridgeState(state="online").payload(), retain=True)
        await client.publish(topics.body, describe_body(load_rig("suit_17").skeleton).payload(), retain=True)
        async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium, size) as (page, _):
            await page.get_by_text(f"{GATEWAY}: online").wait_for()
            if shade == "light":
                await page.get_by_role("checkbox", name="Light").click()
                await page.locator("[data-mantine-color-scheme=light]").first.wait_for()
            found = []
            for name, language in LANGUAGES.items():
                await choose(page, 0, name)
                for tab in TABS:
                    await open_tab(page, translated(language, tab))
                    found += await grave_findings(page, f"{name}, {tab}")
                await open_tab(page, translated(language, "view"))
            assert not found, "\n".join(found)


async def test_a_page_with_a_button_without_a_name_is_found(chromium):
    """The check can fail."""
    async with browser_of(chromium) as browser:
        page = await new_page(browser)
        await page.set_content("<main><button role='tab'></button><button></button></main>")
        assert any("button-name" in found for found in await grave_findings(page, "page"))
