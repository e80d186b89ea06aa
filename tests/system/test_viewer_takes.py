"""Recordings on the page: made, listed, exported, downloaded, replayed; and what the doctor finds there."""

from __future__ import annotations

import re

import pytest

from gateway.outputs.settings import MqttSettings
from gateway.recording import open_recording
from tests.shown_page import SIZES, choose, open_tab, page_of, press
from tests.suit_service import GATEWAY, started

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
        await open_tab(page, "Takes")
        await press(page, "Replay it here")
        await page.get_by_text("press «List recordings», and choose a recording").wait_for()
        await press(page, "7 · Record")
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
        async with page.expect_download() as downloading:
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
        await open_tab(page, "Set up")
        await press(page, "1 · Ports and devices")
        await page.get_by_text("3 modules on body 'arm_3'").wait_for()
        assert await page.get_by_text("suit: port", exact=True).count() == 1
        assert await page.get_by_text("free for recordings in").count() == 1
        await choose(page, 0, "Deutsch")
        await page.get_by_text("Anschlüsse am Rechner des Gateways").wait_for()
