"""Pictures of the live page for docs/guide/viewer.md: ``python -m benchmarks.viewer_pictures [--speed 0.5]``.

The moving one of the README alone: ``--film``.

An emulated person walks and one module loses its power; the recording of it is played to a broker, and the
page is looked at in Chromium, all by the commands that a user types. A busy machine needs a lower speed.
Needs mosquitto, chromium, playwright and the extra ``viewer``.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import re
import sys
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path

from PIL import Image
from playwright.async_api import FloatRect, Page, async_playwright

from benchmarks.emulated_recording import LINK, record_walk
from benchmarks.viewer_browser import browser_page
from devices.emulators.faults.fault_plan import FaultPlan
from devices.emulators.local_broker import mosquitto
from devices.free_ports import free_port
from gateway.emulation.rig import perform
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings

FOLDER = Path(__file__).parent.parent / "docs" / "pictures"
SECONDS = 60.0
UNPLUGGED_S = (20.0, 55.0)
MODULE = 5
"""On the left forearm."""
SEED = 1
GATEWAY = "demo"
DESKTOP, PHONE = (1100, 700), (390, 780)
FILM_FROM_S, FILM_STEP_S, FILM_STEPS = 8.0, 0.08, 30
FILM_CLIP = FloatRect(x=225, y=90, width=420, height=560)
FILM_SIZE, FILM_COLOURS = (240, 320), 48


async def main(speed: str) -> None:
    """Make all pictures."""
    FOLDER.mkdir(exist_ok=True)
    page_port = free_port()
    with tempfile.TemporaryDirectory() as folder, mosquitto() as (broker_port, _):
        recording = _record(Path(folder), broker_port)
        page = ("view", "--port", str(broker_port), "--page-port", str(page_port))
        url = f"http://127.0.0.1:{page_port}"
        async with _command("replay", str(recording), "--speed", speed, "--json"), _command(*page):
            await _live(url, broker_port)
        async with _command("view", str(recording), "--page-port", str(page_port)):
            await _playback(url)


def _record(folder: Path, broker_port: int) -> Path:
    settings = GatewaySettings(
        gateway=GATEWAY,
        links=[LinkSettings(name=LINK, url="/dev/null")],
        rig="suit_17",
        mqtt=MqttSettings(port=broker_port, include=["position", "joint_angles", "sigma"]),
    )
    begin_s, end_s = UNPLUGGED_S
    fault = {"kind": "reset", "module": MODULE, "at": begin_s, "lasts": end_s - begin_s}
    plan = FaultPlan.model_validate({"seed": SEED, "faults": [fault]})
    return record_walk(folder, SECONDS, settings, plan, SEED, perform)


async def _live(url: str, broker_port: int) -> None:
    async with (
        PoseSubscriber(MqttSettings(port=broker_port), GATEWAY) as poses,
        async_playwright() as play,
    ):
        async with browser_page(play, url, DESKTOP) as page:
            await _come_to(poses, 8.0)
            await _shot(page, "viewer_walking")
            await page.get_by_role("tab", name="Plot").click()
            await _choose(page, "angles of left knee")
            await _come_to(poses, UNPLUGGED_S[0] - 2)
            await _shot(page, "viewer_plot")
            await page.get_by_role("tab", name="View").click()
            await _come_to(poses, UNPLUGGED_S[0] + 8)
            await _shot(page, "viewer_unplugged")
            await page.get_by_role("tab", name="Modules").click()
            await _shot(page, "viewer_modules")
        async with browser_page(play, url, PHONE) as page:
            await asyncio.sleep(4)
            await _shot(page, "viewer_phone")
            await _come_to(poses, SECONDS - 0.1)
            await page.get_by_text("NO DATA for").wait_for()
            await _shot(page, "viewer_no_data")


async def _playback(url: str) -> None:
    async with async_playwright() as play, browser_page(play, url, DESKTOP) as page:
        await asyncio.sleep(6)
        await page.get_by_text("pause", exact=True).click()
        await _shot(page, "viewer_playback")


async def film() -> None:
    """Make the moving picture: a recorded walk on the page, moment by moment, however slow a machine is."""
    page_port = free_port()
    with tempfile.TemporaryDirectory() as folder, mosquitto() as (broker_port, _):
        recording = _record(Path(folder), broker_port)
        view = ("view", str(recording), "--page-port", str(page_port))
        url = f"http://127.0.0.1:{page_port}"
        async with _command(*view), async_playwright() as play, browser_page(play, url, DESKTOP) as page:
            await page.get_by_role("button", name="pause").click()
            pictures = [await _moment(page, FILM_FROM_S + FILM_STEP_S * k) for k in range(FILM_STEPS)]
    target = FOLDER / "demo.gif"
    first, *others = (each.quantize(FILM_COLOURS) for each in pictures)
    first.save(target, save_all=True, append_images=others, duration=round(1e3 * FILM_STEP_S), loop=0)
    sys.stdout.write(f"written to {target}\n")


async def _moment(page: Page, seconds: float) -> Image.Image:
    line = page.get_by_role("textbox").filter(visible=True).last
    await line.fill(f"{seconds:.2f}")
    await line.press("Enter")
    near = "|".join(f"{seconds + off:.2f}" for off in (-0.01, 0.0, 0.01))
    await page.get_by_text(re.compile(f"({near}) s, frame")).wait_for()
    await asyncio.sleep(0.4)
    shown = Image.open(io.BytesIO(await page.screenshot(clip=FILM_CLIP)))
    return shown.convert("RGB").resize(FILM_SIZE, Image.Resampling.LANCZOS)


async def _come_to(poses: PoseSubscriber, seconds: float) -> None:
    """Wait until what is played has come so far."""
    first_ns = None
    async for received in poses:
        first_ns = first_ns or received.pose.t_ns - received.pose.seq * 10_000_000
        if received.pose.t_ns - first_ns >= seconds * 1e9:
            return


async def _choose(page: Page, series: str) -> None:
    chooser = page.locator("input[role=combobox]").filter(visible=True).first
    await chooser.click()
    await chooser.fill(series)
    await page.get_by_role("option", name=series).click()


async def _shot(page: Page, name: str) -> None:
    target = FOLDER / f"{name}.png"
    await asyncio.sleep(1.5)
    await page.screenshot(path=target)
    sys.stdout.write(f"written to {target}\n")


@contextlib.asynccontextmanager
async def _command(*arguments: str) -> AsyncIterator[None]:
    """``mocap-gateway`` with these arguments, ended with the block."""
    process = await asyncio.create_subprocess_exec(sys.executable, "-m", "gateway", *arguments)
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.viewer_pictures", description=__doc__)
    parser.add_argument("--speed", default="1", help="of the replay")
    parser.add_argument("--film", action="store_true", help="make the moving picture, and no other")
    asked = parser.parse_args()
    asyncio.run(film() if asked.film else main(asked.speed))
