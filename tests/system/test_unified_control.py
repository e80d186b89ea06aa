"""Unified control over real ports: the gateway's trigger rules, and a replay gives the same poses."""

import asyncio
import json
import logging

import aiomqtt
import numpy as np
import pytest

from devices.emulators.delivery import Encoding
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import Imperfections
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport, SlcanTransport
from devices.link import Chunk, Framing
from firmware_protocol import InertialSample
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.pipeline import Pipeline
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from tests.patience import PATIENCE_S, loop_lateness

pytestmark = pytest.mark.system

RIG = "robot_arm_4"
ON_OWN_TIMER = 3
RADIO = Imperfections(
    latency=0.002,
    jitter=0.001,
    reception=20e-6,
    loss=0.01,
    duplication=0.01,
    clock_skew_ppm=100.0,
    has_random_clock_start=True,
)


class Capture:
    """A service on an emulated suit; all that went into its pipeline, and what came out."""

    def __init__(self, folder, broker_port, medium, module_modes):
        url = f"slcan://{folder}/suit?bitrate=1000000" if medium == "slcan" else f"{folder}/suit"
        transport = SlcanTransport if medium == "slcan" else PtyTransport
        self.settings = GatewaySettings(
            gateway="lab",
            links=[{"name": "suit", "url": url}],
            rig=RIG,
            reconstructor="independent",
            clock={"mode": "trigger"},
            mqtt={"port": broker_port, "health_interval": 0.5},
        )
        self.suit = load_rig(RIG)
        framing = Framing.CAN if medium == "slcan" else Framing.BYTE_STREAM
        made = SuitSettings(mode=3, module_modes=module_modes, encoding=Encoding(framing))
        self.traffic = SuitTraffic(move(dress(self.suit), self.suit.skeleton.name, 1), made, RADIO, 1)
        self.emulated = EmulatedSuit(self.traffic, transport(folder / "suit"))
        self.service = Service(self.settings, self.suit)
        self.inputs, self.frames, self.framing = [], [], framing
        self._feed, self._sent = self.service.pipeline.feed, self.service.pipeline.stream.sent
        self.service.pipeline.feed = self.feed
        self.service.pipeline.stream.sent = self.sent

    def feed(self, chunk):
        self.inputs.append(chunk)
        frames = self._feed(chunk)
        self.frames += frames
        return frames

    def sent(self, chunk):
        self.inputs.append(chunk)
        self._sent(chunk)

    async def run(self):
        """The last health message over MQTT."""
        tasks = [asyncio.create_task(self.emulated.run()), asyncio.create_task(self.service.run())]
        try:
            async with loop_lateness() as self.machine:
                async with asyncio.timeout(2 * PATIENCE_S):
                    while len(self.frames) <= 250 or min(self.answered()) < 250:
                        await asyncio.sleep(0.05)
            async with (
                asyncio.timeout(PATIENCE_S),
                aiomqtt.Client("127.0.0.1", self.settings.mqtt.port) as client,
            ):
                await client.subscribe("mocap/lab/bridge/health")
                async for message in client.messages:
                    return json.loads(message.payload)["statistics"]
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def answered(self):
        """By module: how many triggers it answered."""
        return self.service.pipeline.statistics()["triggers"]["answered"].values() or [0]

    def replay(self):
        """Of a new pipeline fed the same: frames, inertial readings, and when each was really taken.

        The truth: gateway time in ns by module and sequence number of the packet.
        """
        pipeline, readings, truth = Pipeline.from_settings(self.settings, self.suit), [], {}
        pipeline.add_link("suit", self.framing)
        assembler = pipeline.module_stage.assembler
        add = assembler.add
        assembler.add = lambda samples, at: (readings.extend(samples.copy()), add(samples, at))[1]

        def take(got, _chunk):
            truth[got.module, got.sequence] = self._true_ns(got.module, got.module_time_us)

        pipeline.stream.listen(InertialSample, take)
        frames = []
        for given in self.inputs:
            if isinstance(given, Chunk):
                frames += pipeline.feed(given)
            else:
                pipeline.sent(given)
        return frames, readings, truth

    def _true_ns(self, module, stamp_us):
        clock = self.traffic.senders[module].clock
        return self.emulated.instant_ns(clock.true_time((stamp_us - clock.start_us) % 2**32 * 1e-6))


@pytest.mark.parametrize("medium", ["pty", "slcan"])
async def test_samples_belong_to_the_triggers(tmp_path, mosquitto, medium, caplog):
    capture = Capture(tmp_path, mosquitto.port, medium, {ON_OWN_TIMER: 2})
    with caplog.at_level(logging.WARNING):
        statistics = await capture.run()
    timer, triggers = statistics["trigger_timer"], statistics["triggers"]
    assert timer["sent"] + timer["skipped"] > 200
    assert 0 < timer["jitter_rms_us"] <= timer["worst_jitter_us"]
    assert set(triggers["answered"]) == {"0", "1", "2"}
    assert sum(triggers["missed"].values()) > 0  # 2 % of the ways there and back are lost
    assert set(triggers["untriggered"]) == {str(ON_OWN_TIMER)}
    assert caplog.text.count("module 3 samples on its own timer") == 1

    frames, readings, truth = capture.replay()
    assert len(frames) == len(capture.frames) > 200
    for live, again in zip(capture.frames, frames, strict=True):
        assert live.time_ns == again.time_ns
        np.testing.assert_array_equal(live.q_wb, again.q_wb)

    triggered = [reading for reading in readings if reading["module"] != ON_OWN_TIMER]
    sent = {given.sent_ns for given in capture.inputs if not isinstance(given, Chunk)}
    assert {int(reading["time_ns"]) for reading in triggered} <= sent
    late_us = {}
    for reading in triggered:
        module, sequence, time_ns, *_ = reading.tolist()
        late_ns = truth[module, sequence % 2**16] - time_ns
        assert late_ns > 0  # never before the trigger left
        late_us.setdefault(time_ns, []).append(late_ns * 1e-3)
    apart_us = [max(of_one) - min(of_one) for of_one in late_us.values() if len(of_one) == 3]
    assert len(apart_us) > 50
    late = [late for of_one in late_us.values() for late in of_one]
    assert np.median(late) < 15_000 + 2e6 * capture.machine.median_s
    assert np.quantile(apart_us, 0.99) < 200  # all modules sampled at once, but for their interrupts
