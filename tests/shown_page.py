"""The viewer and a real browser that shows its page."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateway.outputs.settings import MqttSettings
from gateway.support.credentials import AccessToken
from gateway.viewer.gate import Door, Gate
from tests.suit_service import GATEWAY

viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
playwright_api = pytest.importorskip("playwright.async_api", reason="playwright is not installed")

TOKEN = "a-token-of-this-test"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WAIT_MS = 60_000
SIZES = [(1100, 800), (390, 780)]
"""A desktop and a phone."""


@contextlib.asynccontextmanager
async def browser_of(chromium: str) -> AsyncIterator[Any]:
    """Chromium, with the graphics of a machine that has none."""
    async with playwright_api.async_playwright() as play:
        browser = await play.chromium.launch(executable_path=chromium, args=FLAGS)
        yield browser
        await browser.close()


async def new_page(browser: Any, size: tuple[int, int] = (800, 600)) -> Any:
    """A page without the cookies of another one."""
    page = await (await browser.new_context()).new_page()
    await page.set_viewport_size({"width": size[0], "height": size[1]})
    page.set_default_timeout(WAIT_MS)
    return page


@contextlib.asynccontextmanager
async def page_of(
    settings: MqttSettings, unused_port: int, chromium: str, size: tuple[int, int] = (800, 600)
) -> AsyncIterator[tuple[Any, list[str]]]:
    """The viewer, and a browser's page that shows it, with the addresses of all that it loads."""
    from gateway.viewer.inner_page import served_behind_gate  # noqa: PLC0415 - needs the extra
    from gateway.viewer.live import LiveViewer  # noqa: PLC0415 - needs the extra

    gate_pass = AccessToken(secrets.token_urlsafe(32))
    pages = contextlib.ExitStack()
    server = pages.enter_context(served_behind_gate(gate_pass))
    showing = asyncio.create_task(LiveViewer(server, settings, GATEWAY).run(waits=True))
    gate = Gate("127.0.0.1", unused_port, server.get_port(), Door(AccessToken(TOKEN)), gate_pass=gate_pass)
    async with gate, browser_of(chromium) as browser:
        page = await new_page(browser, size)
        loaded: list[str] = []
        page.on("request", lambda request: loaded.append(request.url))
        stranger = await page.goto(f"http://127.0.0.1:{unused_port}")
        assert stranger.status == 401
        await page.goto(f"http://127.0.0.1:{unused_port}/?token={TOKEN}")
        assert TOKEN not in page.url
        try:
            yield page, loaded
        except Exception:
            print(f"what the page showed:\n{await page.locator('body').inner_text()}")
            raise
    showing.cancel()
    await asyncio.gather(showing, return_exceptions=True)
    pages.close()


async def choose(page: Any, which: int, option: str) -> None:
    """Choose from a list of the tab that is open."""
    chooser = page.locator("input[role=combobox]").filter(visible=True).nth(which)
    await chooser.click()
    await chooser.fill(option)
    await page.get_by_role("option", name=option).click()


async def press(page: Any, name: str) -> None:
    """Press a button of the tab that is open."""
    await page.get_by_role("button", name=name, exact=True).filter(visible=True).click()


async def open_tab(page: Any, name: str) -> None:
    """Bring a tab to the front."""
    await page.get_by_role("tab", name=name, exact=True).click()


async def reach(page: Any, name: str) -> None:
    """Go to what bears a name by the Tab key alone."""
    for _ in range(90):
        await page.keyboard.press("Tab")
        if await page.evaluate(_FOCUSED) == name:
            return
    raise AssertionError(f"no Tab leads to '{name}'")


_FOCUSED = """() => {
    const e = document.activeElement;
    const label = e.labels && e.labels[0] ? e.labels[0].innerText : "";
    return (label || e.innerText || e.getAttribute("aria-label") || "").trim();
}"""
