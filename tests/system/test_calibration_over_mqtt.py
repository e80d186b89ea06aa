"""A running service is calibrated and reset by requests; its recording replays bit for bit."""

from __future__ import annotations

import asyncio
import contextlib
import threading

import numpy as np
import pytest

from devices.calibration_script import timetable
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.motion.calibrating import calibration_motion, strapped_on
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from gateway.body.rig import load_rig
from gateway.calibration.procedure import PROCEDURE
from gateway.emulation.rig import dress
from gateway.modules.operations import RequestError
from gateway.modules.remote import remote_suit
from gateway.outputs.settings import MqttSettings
from gateway.recording import open_recording
from gateway.recording.solving import verify
from gateway.service.service import Service
from gateway.settings import GatewaySettings, RecordingSettings
from gateway.sources.link_settings import LinkSettings
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system


@contextlib.asynccontextmanager
async def served(mosquitto, folder):
    """An emulated lower body that stands in the N-pose, and a service that records from the start."""
    suit = load_rig("suit_lower_7")
    body = strapped_on(dress(suit), 5)
    settings = SuitSettings(gravity=suit.gravity, magnetic_field=suit.magnetic_field, sampling_rate_hz=50)
    traffic = SuitTraffic(calibration_motion(body, 5, 1.0), settings)
    emulated = EmulatedSuit(traffic, PtyTransport(folder / "suit"))
    mqtt = MqttSettings(port=mosquitto.port)
    service = Service(
        GatewaySettings(
            gateway="lab",
            links=[LinkSettings(name="suit", url=str(folder / "suit"))],
            rig="suit_lower_7",
            reconstructor="independent",
            mqtt=mqtt,
            recording=RecordingSettings(at_start=True, folder=str(folder / "recordings")),
        ),
        suit,
    )
    tasks = [asyncio.create_task(service.run())]
    try:
        async with asyncio.timeout(PATIENCE_S):
            while not service.requests.is_connected:
                await asyncio.sleep(0.01)
            tasks.append(asyncio.create_task(emulated.run()))  # the person does not stand still for ever
            while not service.pipeline.skeleton_frames:
                await asyncio.sleep(0.01)
        yield service, mqtt
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def test_calibrated_and_reset_while_running(mosquitto, tmp_path, monkeypatch, until):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.chdir(tmp_path)
    async with served(mosquitto, tmp_path) as (service, mqtt):
        prepare, threads = service.pipeline.prepare, []

        def prepared(data):
            threads.append(threading.current_thread())
            return prepare(data)

        monkeypatch.setattr(service.pipeline, "prepare", prepared)
        async with remote_suit(mqtt, "lab", "calibration") as ask:
            with pytest.raises(RequestError, match="calibration/begin"):
                await ask.perform("result", {})
            steps = (await ask.perform("begin", {"field": True}))["steps"]
            assert steps[0]["step"] == "n_pose"
            async with asyncio.timeout(PATIENCE_S):
                while not all(one["heard"] for one in (await ask.perform("status", {}))["modules"]):
                    await asyncio.sleep(0.05)
            with pytest.raises(RequestError, match="there is no step 'dance'"):
                await ask.perform("step", {"step": "dance"})
            await ask.perform("step", {"step": "n_pose", "countdown_s": 0.2, "seconds": 3.0})
            with pytest.raises(RequestError, match="under way"):
                await ask.perform("step", {"step": "squat"})
            assert len((await ask.perform("status", {}))["modules"]) == 7
            async with asyncio.timeout(PATIENCE_S):
                while (await ask.perform("status", {}))["phase"] != "ready":
                    await asyncio.sleep(0.1)
            result = await ask.perform("result", {})
            assert {module["quality"] for module in result["modules"]} <= {"good", "fair", "poor"}
            before = service.pipeline.suit.sensor_to_segment.copy()
            accepted = await ask.perform("accept", {"poor": True, "save": True})
            assert len(accepted["accepted"]) == 7
            assert len(threads) == 1
            assert threads[0] is not threading.main_thread()  # poses went on meanwhile
            assert not np.allclose(service.pipeline.suit.sensor_to_segment, before)
            worn = load_rig(str(tmp_path / accepted["file"]))
            np.testing.assert_allclose(
                worn.sensor_to_segment, service.pipeline.suit.sensor_to_segment, atol=1e-5
            )
            assert (await ask.perform("status", {}))["phase"] == "idle"
            assert (await ask.perform("history", {}))["versions"] == []
        async with remote_suit(mqtt, "lab", "reset") as ask:
            frames = service.pipeline.skeleton_frames
            while service.pipeline.skeleton_frames < frames + 10:
                await asyncio.sleep(0.05)
            turned = await ask.perform("heading", {"facing_deg": 90})
            assert "turned_deg" in turned
            with pytest.raises(RequestError, match="there is no request 'reset/sideways'"):
                await ask.perform("sideways", {})
            await ask.perform("full", {})
            await ask.perform("mounting", {})
        await until(lambda: service.pipeline.skeleton_frames > frames + 100)
    (path,) = (tmp_path / "recordings").glob("*.mcap")
    recording = open_recording(path)
    names = [event.name for event in recording.events()]
    assert names.count("reset") == 3
    assert names.count("calibrated") == 1
    verified = verify(recording)
    assert verified.is_identical, verified.difference
    assert verified.compared > 100


def test_the_timetable_has_every_step_of_the_procedure():
    assert set(timetable()) == {step.name for step in PROCEDURE}
