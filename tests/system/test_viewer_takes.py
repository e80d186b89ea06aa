"""Recordings on the page: made, listed, exported, downloaded, replayed; and what the doctor finds there."""

from __future__ import annotations

import asyncio
import re

import pytest

from gateway.cli.run import _load as load_service
from gateway.cli.run import _Supervisor as Supervisor
from gateway.outputs.settings import MqttSettings
from gateway.recording import open_recording
from gateway.settings import load_gateway_settings
from tests.shown_page import SIZES, TOKEN, WAIT_MS, choose, new_page, open_tab, page_of, press, reach
from tests.suit_service import GATEWAY, started, suit_config

pytestmark = pytest.mark.system

_TWO_SECONDS = re.compile("REC 0:(0[2-9]|[1-5])")  # or more: a busy page passes over some


@pytest.fixture
def configured(command, mosquitto, tmp_path, monkeypatch):
    """``await configured()``: a gateway that reads an emulated arm, in the test's folder."""
    monkeypatch.chdir(tmp_path)

    async def start():
        return await started(command, tmp_path, mosquitto.port, "arm_3")

    return start


@pytest.mark.parametrize("size", SIZES, ids=["desktop", "phone"])
async def test_a_take_is_recorded_listed_replayed_exported_and_downloaded(
    mosquitto, unused_port, chromium, configured, tmp_path, size
):
    await configured()
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium, size) as (page, _):
        await page.get_by_text(f"{GATEWAY}: online").wait_for()
        await open_tab(page, "7 Takes")
        assert not await page.get_by_role("button", name="Replay it here").is_visible()
        await press(page, "Record")
        await page.get_by_text("recording to ").wait_for()
        await page.get_by_text(_TWO_SECONDS).wait_for()
        await press(page, "Stop")
        await page.get_by_text("recorded 0:").wait_for()
        (file,) = (tmp_path / "recordings").glob("*.mcap")
        assert await page.get_by_role("img", name=file.name).count() == 1
        await choose(page, 0, file.name)
        await press(page, "Replay it here")
        await page.get_by_text(f"REPLAY {file.name}").wait_for()
        await press(page, "Back to live")
        await page.get_by_text(f"{GATEWAY}: online").wait_for()
        async with page.expect_download(timeout=3 * WAIT_MS) as downloading:  # a program of its own writes it
            await press(page, "Export and download")
        exported = await downloading.value
        assert exported.suggested_filename == file.with_suffix(".bvh").name
        text = (await exported.path()).read_text()
        assert text.startswith("HIERARCHY")
        assert text == file.with_suffix(".bvh").read_text()
        async with page.expect_download() as downloading:
            await press(page, "Download the recording")
        (tmp_path / "fetched.mcap").write_bytes((await (await downloading.value).path()).read_bytes())
        assert open_recording(tmp_path / "fetched.mcap").skeleton_arrays().time_ns.size > 50


async def test_ports_and_findings_are_told_before_anything_is_set_up(
    mosquitto, unused_port, chromium, configured
):
    await configured()
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium) as (page, _):
        await page.get_by_text(f"{GATEWAY}: online").wait_for()
        await open_tab(page, "1–3 Suit")
        await press(page, "1 · Ports and devices")
        await page.get_by_text("things that are well").click()
        await page.get_by_text("3 modules on body 'arm_3'").wait_for()
        assert await page.get_by_text("suit: port", exact=True).count() == 1
        assert await page.get_by_text("free for recordings in").count() == 1
        await open_tab(page, "View")
        await choose(page, 0, "Deutsch")
        await open_tab(page, "1–3 Anzug")
        await page.get_by_text("Anschlüsse am Rechner des Gateways").wait_for()


async def test_a_link_without_a_port_is_given_one_on_the_page(
    mosquitto, unused_port, chromium, command, tmp_path, monkeypatch
):
    """The gateway runs in this process, for only here its computer's ports can be those of an emulator."""
    (by_id := tmp_path / "by-id").mkdir()
    monkeypatch.setattr("devices.links.serial_ports.BY_ID", by_id)
    port = by_id / "usb-Receiver-if00"
    suit = command("emulate", "--rig", "arm_3", "--on", "pty", "--json", "--link", port)
    await suit.until_it_says('"url"')
    config = suit_config(tmp_path, mosquitto.port, "arm_3")
    running = asyncio.create_task(Supervisor(config, load_service(config)).run())
    try:
        async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium) as (page, _):
            await page.get_by_text(f"{GATEWAY}: online").wait_for()
            await open_tab(page, "1–3 Suit")
            await press(page, "1 · Ports and devices")
            await page.get_by_text("no such port").first.wait_for()
            await choose(page, 1, port.name)
            await press(page, "Use this port")
            await page.get_by_role("status").filter(has_text="look for modules").wait_for()
            await page.get_by_text(re.compile(r"[1-9]\d* poses/s")).wait_for()
        assert load_gateway_settings(config).links[0].url == str(port)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_everything_is_reached_by_keyboard_alone(mosquitto, unused_port, chromium, configured):
    """Tabs, buttons, lists and switches, without a pointer."""
    await configured()
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium) as (page, _):
        await page.get_by_text("poses/s").wait_for()
        await reach(page, "1–3 Suit")
        await page.keyboard.press("Enter")
        await reach(page, "2 · Look for modules")
        await page.keyboard.press("Enter")
        await page.get_by_text("devices heard").wait_for()
        await reach(page, "Segment")
        await page.keyboard.type("right forearm")
        await page.keyboard.press("ArrowDown")
        await page.keyboard.press("Enter")
        await page.get_by_text("right forearm", exact=True).first.wait_for()
        await reach(page, "Write to the modules")
        await page.keyboard.press("Space")
        assert await page.get_by_role("checkbox", name="Write to the modules").is_checked()


async def test_a_run_goes_on_after_a_reload_and_on_another_page(
    mosquitto, unused_port, chromium, configured, tmp_path
):
    """Left in the middle, seen by two, and a take that is deleted while it is played."""
    await configured()
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium) as (page, _):
        await page.get_by_text("poses/s").wait_for()
        await open_tab(page, "7 Takes")
        await press(page, "Record")
        await page.get_by_text(_TWO_SECONDS).wait_for()
        await page.reload()
        await page.get_by_text(re.compile("REC 0:")).wait_for()
        other = await new_page(page.context.browser)
        await other.goto(f"http://127.0.0.1:{unused_port}/?token={TOKEN}")
        await open_tab(other, "7 Takes")
        await press(other, "Stop")
        await other.get_by_text("recorded 0:").wait_for()
        await page.get_by_text(re.compile("REC 0:")).wait_for(state="detached")
        await open_tab(page, "7 Takes")
        (file,) = (tmp_path / "recordings").glob("*.mcap")
        await choose(page, 0, file.name)
        await press(page, "Replay it here")
        await other.get_by_text(f"REPLAY {file.name}").wait_for()
        file.unlink()
        await press(page, "Export and download")
        await page.get_by_text(f"there is no recording {file.name}").wait_for()
        assert await page.get_by_text(f"REPLAY {file.name}").count() == 1
        await press(page, "Back to live")
        await page.get_by_text(f"{GATEWAY}: online").wait_for()
