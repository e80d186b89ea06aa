"""An x-IMU3 over TCP, through source, clocks, reconstruction, recording and replay."""

from __future__ import annotations

import asyncio
import contextlib

import numpy as np

from devices.emulators.imperfections import Imperfections
from devices.emulators.makers.vendor_emulator import MixedSuit
from devices.emulators.makers.ximu3 import Ximu3Emulator
from devices.emulators.motion.motions import generic_motion
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from gateway.body.rig import load_rig
from gateway.contract.balances import unaccounted
from gateway.emulation.rig import dress
from gateway.frames import Status
from gateway.geometry.comparison import orientation_error
from gateway.outputs.settings import MqttSettings
from gateway.recording import open_recording
from gateway.recording.solving import verify
from gateway.service.service import Service
from gateway.settings import GatewaySettings, RecordingSettings

SECONDS = 8.0
FIELD_UT = 49.0


def spoken(motion, module):
    """(s, messages) of a module that moves so."""
    traffic = SuitTraffic(motion, SuitSettings(), Imperfections(), 1)
    emulator = MixedSuit(Ximu3Emulator(module, FIELD_UT))
    for sent in traffic.transmissions(SECONDS):
        _, data = emulator.feed(sent.data)
        if data:
            yield sent.time_s, data


async def test_a_device_moves_a_body_and_replays_bit_for_bit(tmp_path, mosquitto, until):
    suit = load_rig("single")
    motion = generic_motion(dress(suit), 1)
    messages, times = list(spoken(motion, suit.module_ids[0])), []

    async def send(_reader, writer):
        loop = asyncio.get_running_loop()
        start = loop.time()
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            for k, (at_s, data) in enumerate(messages):
                if k % 100 in (70, 71):
                    continue  # lost on the way
                await asyncio.sleep(max(0.0, start + at_s - loop.time()))
                writer.write(data + (b"\xc9damaged\n" if len(times) % 100 == 50 else b""))
                times.append(at_s)
                await writer.drain()
            await asyncio.sleep(3600)

    server = await asyncio.start_server(send, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    link = {"name": "arm", "url": f"tcp://127.0.0.1:{port}", "carries": "ximu3"}
    link["module"] = suit.module_ids[0]
    settings = GatewaySettings(
        gateway="lab",
        links=[link],
        rig="single",
        reconstructor="independent",
        mqtt=MqttSettings(port=mosquitto.port),
        recording=RecordingSettings(at_start=True, folder=str(tmp_path), min_free_mb=1, warn_free_mb=1),
    )
    service = Service(settings, suit)
    serving = asyncio.create_task(service.run())
    try:
        await until(lambda: service.pipeline.skeleton_frames >= 0.9 * SECONDS * 100)
        figures = service.observer.figures()
        assert unaccounted(service.balances()) == {}
    finally:
        serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await serving
        server.close()
    assert figures.links[0].dropped["bad_length"] > 3
    assert figures.modules[0].availability == "online"
    assert figures.modules[0].lost >= 12  # two in a hundred, the device numbers none
    recording = open_recording(service.recording.status()["file"])
    assert recording.meta.links == {"arm": "ximu3"}
    assert verify(recording).is_identical

    poses = list(recording.skeleton_frames())[300:]
    assert {int(pose.status[0]) for pose in poses} <= {Status.MEASURED, Status.INTERPOLATED, Status.HELD}
    begun = next(iter(recording.chunks())).arrived_ns * 1e-9 - messages[0][0]
    true = motion.state(np.array([pose.time_ns * 1e-9 - begun for pose in poses]))
    errors = orientation_error(np.array([pose.q_wb for pose in poses]), true.q_wb)
    assert np.degrees(np.sqrt(np.nanmedian(errors.inclination**2))) < 3.0
