"""Chromium without a screen, looking at the live page; it renders on the processor."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
from collections.abc import AsyncIterator, Callable

from playwright.async_api import Error, Page, Playwright

FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE_S = 90.0


def chromium_program() -> str:
    """Where it is installed. Raises ``SystemExit`` where it is not."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        raise SystemExit("this needs chromium: apt install chromium")
    return program


@contextlib.asynccontextmanager
async def browser_page(
    play: Playwright, url: str, size: tuple[int, int], prepare: Callable[[Page], None] | None = None
) -> AsyncIterator[Page]:
    """A page of that width and height, prepared before it is opened."""
    browser = await play.chromium.launch(executable_path=chromium_program(), args=FLAGS)
    page = await browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.set_default_timeout(PATIENCE_S * 1e3)
    try:
        if prepare is not None:
            prepare(page)
        await _open(page, url)
        yield page
    finally:
        await browser.close()


async def _open(page: Page, url: str) -> None:
    """Raises what the browser said if nobody has answered for too long."""
    for wait_s in (0.5,) * round(PATIENCE_S / 0.5):
        with contextlib.suppress(Error):
            await page.goto(url)
            return
        await asyncio.sleep(wait_s)
    await page.goto(url)
