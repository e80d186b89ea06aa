"""From nothing configured to a BVH file on the page alone, with what goes wrong on the way; a desktop's page
is dark, a phone's light. Each step is held against the rules of axe-core.

The suit has two modules of one id, a dead one and one that is worn upside down; the broker is restarted in
the middle. The emulated wearer does what the page says, when it says so.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.calibration_script import timetable
from devices.emulators.bodies import NO_MODULE
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.motion.calibrating import calibration_motion
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from devices.link import gateway_time_ns
from gateway.body.rig import load_rig
from gateway.calibration.quality import GOOD
from gateway.emulation.rig import dress, worn_wrong
from gateway.outputs.settings import MqttSettings
from gateway.settings import load_gateway_settings
from gateway.viewer.texts import ENGLISH, step_name
from tests.accessible_page import grave_findings
from tests.shown_page import SIZES, choose, open_tab, page_of, press
from tests.suit_service import GATEWAY, started, suit_config

pytestmark = [
    pytest.mark.system,
    pytest.mark.slow(reason="the wearer does all poses and movements in real time"),
    pytest.mark.timeout(900),
]
PICTURES = os.environ.get("MOCAP_PICTURES")
"""Folder that pictures of the steps go to, such as docs/pictures; none: none are made."""
ON_A_PHONE = {"3_assign", "4_sensors", "6_check"}
"""Pictures that are made of the phone's page too."""
UPSIDE_DOWN, DEAD = 12, 6
"""Left shank, left hand."""
STANDING_S = 0.5
"""Of the script: upright and still."""
AFTER_S, AFTER_N_POSE_S = 1.8, 0.8
"""Until the wearer stands as before a step; after the N-pose the script's arms soon rise for the T-pose."""
TOLD_LATE_S = 0.4
"""The page shows whole seconds, and looks for them so often: so much more than it says may be left."""
TUMBLING_MS = 240_000.0
"""For the emulated box to have lain and turned enough."""
LONGEST_S = 300.0
"""That it may take a person."""


class ObedientMotion(BodyMotion):
    """Stands until it is told to do a step of the calibration; does it, and stands again."""

    def __init__(self, body, seed):
        self.body, self._script = body, calibration_motion(body, seed)
        self._told = [(0.0, 0.0, STANDING_S, STANDING_S)]
        """From when on, and until when, s; the script's time at the begin and after the end."""

    def do(self, step, now_s, left_s):
        """Be ready for a step in ``left_s``."""
        begin, end = timetable()[step]
        length_s = left_s + end - begin + (AFTER_N_POSE_S if step == "n_pose" else AFTER_S)
        self._told.append((now_s, now_s + length_s, begin - left_s, STANDING_S))

    def state(self, t):
        return self._script.state(self._script_times(np.atleast_1d(np.asarray(t, np.float64))))

    def module_state(self, segments, times):
        return self._script.module_state(segments, self._script_times(times))

    def _script_times(self, times):
        found = np.full(times.shape, STANDING_S)
        for begin_s, end_s, script_s, _ in self._told:
            doing = (times >= begin_s) & (times < end_s)
            found = np.where(doing, script_s + times - begin_s, found)
        return found


class Way:
    """The page and its wearer on the way, and the seconds in which the wearer had to move."""

    def __init__(self, page, kind, motion, suit):
        self.page, self._kind, self._motion, self._suit = page, kind, motion, suit
        self.grave = []
        """What breaks a rule gravely, a line each."""

    async def look(self, name, text=None):
        """See that this step is accessible; where pictures are wanted, keep one, with the text in it."""
        if text is not None:
            shown = self.page.get_by_text(text).filter(visible=True).last
            await shown.evaluate("element => element.scrollIntoView({block: 'center'})")
        self.grave += await grave_findings(self.page, name)
        if PICTURES is not None and (self._kind == "desktop" or name in ON_A_PHONE):
            await asyncio.sleep(1.0)
            path = Path(PICTURES) / f"setup_{name}_{self._kind}.jpg"
            await self.page.screenshot(path=path, type="jpeg", quality=80)

    async def sees(self, text):
        await self.page.get_by_text(text).first.wait_for()

    async def obeys(self, step):
        """Do a step when the page counts down to it: it is known how long is left when its number changes."""
        await self.sees("Begins in")
        told = seen = await self._countdown()
        while seen == told:
            seen = await self._countdown()
        left_s = TOLD_LATE_S + (float(seen[0]) if seen else 0.0)
        ahead_s = 0.2  # the suit has already sent what comes before
        self._motion.do(step, self._suit.motion_time_s(gateway_time_ns()) + ahead_s, left_s - ahead_s)

    async def _countdown(self):
        """Seconds that the page says are left, in a list; empty when it no longer counts."""
        shown = await self.page.get_by_text("Begins in").all_text_contents()
        return re.findall(r"Begins in (\d+) s", " ".join(shown))


@pytest.fixture
async def configured(command, mosquitto, tmp_path, monkeypatch):
    """A gateway with the shipped rig on the port of a suit, and nothing set up; the wearer and the suit."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    rig = load_rig("suit_17")
    body = worn_wrong(dress(rig), [UPSIDE_DOWN], [])
    body = replace(body, module_ids=np.where(body.module_ids == DEAD, NO_MODULE, body.module_ids))
    motion = ObedientMotion(body, 3)
    settings = SuitSettings(
        gravity=rig.gravity, magnetic_field=rig.magnetic_field, sampling_rate_hz=50, stored_ids={16: 15}
    )
    suit = EmulatedSuit(SuitTraffic(motion, settings), PtyTransport(tmp_path / "suit"))
    wearing = asyncio.create_task(suit.run())
    config = suit_config(
        tmp_path, mosquitto.port, "suit_17", assembly={"rate_hz": 50}, allow_device_writes=True
    )
    command("run", "-c", config)
    yield motion, suit
    wearing.cancel()
    await asyncio.gather(wearing, return_exceptions=True)


@pytest.mark.parametrize("size", SIZES, ids=["desktop", "phone"])
async def test_a_suit_is_set_up_checked_and_captured_without_a_terminal(
    mosquitto, unused_port, chromium, configured, tmp_path, size
):
    motion, suit = configured
    kind = "phone" if size == SIZES[1] else "desktop"
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium, size) as (page, _):
        way, begun_s = Way(page, kind, motion, suit), time.monotonic()
        await way.sees("poses/s")
        if kind == "phone":
            await page.get_by_role("checkbox", name="Light").click()
        await modules_are_assigned(way)
        await a_module_upside_down_is_seen(way)
        await the_body_is_calibrated(way, mosquitto)
        await all_but_the_dead_module_follow(way)
        await a_take_becomes_a_file(way, tmp_path)
        assert load_gateway_settings(tmp_path / "gateway.yaml").rig == "suit_17.worn.yaml"
        took_s = time.monotonic() - begun_s
    assert not way.grave, "\n".join(way.grave)
    print(f"{kind}: {took_s:.0f} s")
    if PICTURES is not None:  # of a machine that does little else
        assert took_s < LONGEST_S


async def modules_are_assigned(way):
    """Steps 1 to 3, with an id conflict and a dead module."""
    page = way.page
    await open_tab(page, "1–3 Suit")
    await press(page, "1 · Ports and devices")
    await way.sees("things that are well")
    await way.look("1_ports")
    await page.get_by_text("things that are well").click()
    await way.sees("free for recordings in")
    await press(page, "2 · Look for modules")
    await way.sees("2 modules have id 15")
    await way.look("2_modules", "2 modules have id 15")
    await page.get_by_role("checkbox", name="Write to the modules").click()
    await press(page, "Give them ids of their own")
    await way.sees("modules that have ids of their own now")
    await choose(page, 0, "63 · ")
    await choose(page, 1, "right foot")
    await way.look("3_assign")
    await press(page, "Assign")
    await way.sees("written: right foot: module 63 becomes 16")
    await page.get_by_text("not heard: left hand", exact=True).wait_for()


async def a_module_upside_down_is_seen(way):
    """Step 6 before step 5: the shank goes the other way."""
    await open_tab(way.page, "6 Check")
    await does(way, "left leg", "left_leg")
    await way.page.get_by_role("row", name="left leg left shank goes the other way").wait_for()
    await way.look("6_wrong_way_round", "goes the other way")


async def does(way, movement, step):
    """One movement of the check."""
    await choose(way.page, 0, movement)
    await press(way.page, "This movement alone")
    await way.obeys(step)
    await way.sees("segments follow")


async def the_body_is_calibrated(way, mosquitto):
    """Step 5; the broker is restarted in the middle."""
    page = way.page
    await open_tab(page, "5 Body")
    await page.get_by_role("textbox", name="Height, m").fill("175")
    await press(page, "Keep the measures")
    await way.sees("'height_m' is 175.0: less than 2.6 is wanted")
    await page.get_by_role("textbox", name="Height, m").fill("1.75")
    await press(page, "Keep the measures")
    await way.sees("height 1.75 m is used and kept in")
    await way.sees("poses/s")
    await press(page, "Begin with the poses")
    await way.sees("7 steps: do them one after another")
    for step in timetable():
        await choose(page, 0, step_name(ENGLISH, step))
        await press(page, "Do this step")
        await way.obeys(step)
        if step == "squat":
            await way.look("5_countdown")
        await page.get_by_text("done: ").filter(has_text=step_name(ENGLISH, step)).wait_for()
        if step == "t_pose":
            await asyncio.to_thread(mosquitto.stop)
            await way.sees("NO BROKER")
            await asyncio.to_thread(mosquitto.start)
            await way.sees(f"{GATEWAY}: online")
            await press(page, "Go on with what was begun")
            await page.get_by_text("done: ").filter(has_text="N pose, T pose").wait_for()
    await press(page, "Work out how modules sit")
    await way.sees("of 17 modules are good")
    await way.look("5_score", "of 17 modules are good")
    scored = await page.get_by_role("row", name=f"{UPSIDE_DOWN} left shank").inner_text()
    assert float(re.search(r"0\.\d+|1\.00", scored)[0]) >= GOOD, scored
    await press(page, "Use it")
    await way.sees("in use and kept")


async def all_but_the_dead_module_follow(way):
    """Step 6."""
    page = way.page
    await open_tab(page, "6 Check")
    for movement, step in (("left leg", "left_leg"), ("right leg", "right_leg"), ("left arm", "arms")):
        await does(way, movement, step)
    await page.get_by_role("row", name="left arm left hand nothing is heard").wait_for()
    rows = [" ".join(row.split()) for row in await page.get_by_role("row").all_inner_texts()]
    wanted = [f"left leg left {part} follows" for part in ("thigh", "shank", "foot")]
    assert {*wanted, "right leg right foot follows"} <= set(rows)
    await way.look("6_check", "nothing is heard")
    await press(page, "Take the red away")


async def a_take_becomes_a_file(way, folder):
    """Step 7."""
    page = way.page
    await open_tab(page, "7 Takes")
    await press(page, "Record")
    await way.sees(re.compile("REC 0:(0[5-9]|[1-5])"))
    await way.look("7_recording")
    await press(page, "Stop")
    await way.sees("recorded 0:")
    (file,) = (folder / "recordings").glob("*.mcap")
    await choose(page, 0, file.name)
    async with page.expect_download() as downloading:
        await press(page, "Export and download")
    exported = folder / "fetched.bvh"
    shutil.copy(await (await downloading.value).path(), exported)
    await way.sees("kept in line with what they hang from: left hand")
    await way.look("7_takes", "kept in line with")
    text = exported.read_text()
    assert text.startswith("HIERARCHY")
    frames = int(text.partition("Frames:")[2].split()[0])
    assert frames > 150
    assert len(text.partition("Frame Time:")[2].splitlines()) > frames


@pytest.mark.parametrize("size", SIZES, ids=["desktop", "phone"])
async def test_sensors_are_calibrated_without_a_terminal(
    mosquitto, unused_port, chromium, command, tmp_path, monkeypatch, size
):
    """Step 4: the modules lie in a box that is put down and turned, and it is told what to do with it."""
    monkeypatch.chdir(tmp_path)
    words = ["--tumbling", "--imperfections", "uncalibrated"]
    await started(command, tmp_path, mosquitto.port, "arm_3", *words, allow_device_writes=True)
    kind = "phone" if size == SIZES[1] else "desktop"
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium, size) as (page, _):
        way = Way(page, kind, None, None)
        await way.sees("poses/s")
        await open_tab(page, "4 Sensors")
        await press(page, "Begin with the sensors")
        await way.sees("Put it on another side, or askew, and let it lie there")
        await way.look("4_sensors")
        await page.get_by_text("That is enough: press").wait_for(timeout=TUMBLING_MS)
        await press(page, "That is enough")
        await way.sees("of 3 modules are good")
        await way.look("4_result")
        await press(page, "Keep it in the rig file")
        await way.sees("kept for 3 modules, in")
        assert not way.grave, "\n".join(way.grave)
    assert set(load_rig(str(tmp_path / "arm_3.worn.yaml")).calibrations) == {1, 8, 9}
