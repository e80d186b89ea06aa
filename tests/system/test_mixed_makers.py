"""One body that wears an x-IMU3 on the pelvis, WitMotion on the arms and our modules elsewhere."""

from __future__ import annotations

import asyncio
import contextlib

import numpy as np
import pytest

from devices.emulators.imperfections import TYPICAL
from devices.emulators.makers.vendor_emulator import MixedSuit
from devices.emulators.makers.witmotion import WitMotionEmulator
from devices.emulators.makers.ximu3 import Ximu3Emulator
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk
from gateway.body.rig import load_rig
from gateway.contract.balances import unaccounted
from gateway.emulation.rig import dress, move_about
from gateway.frames import InertialBatch, Status
from gateway.geometry.comparison import orientation_error
from gateway.outputs.settings import MqttSettings
from gateway.pipeline import Pipeline, sources_from_settings
from gateway.recording import open_recording
from gateway.recording.solving import verify
from gateway.service.service import Service
from gateway.settings import GatewaySettings, RecordingSettings
from tests.running_suit import running

pytestmark = pytest.mark.system

SECONDS, SETTLED_S = 20.0, 10.0
FIELD_UT = 49.0
RIG = "suit_17"
BEGUN_NS = 1_700_000_000 * 10**9
TICK_S = 0.02
OWN = "legs"


class Worn:
    """The body, who is on which link, and what they say."""

    def __init__(self, seconds):
        self.suit = load_rig(RIG)
        names = self.suit.skeleton.segment_names
        rows = self.suit.module_of_segment.tolist()
        self.ids = {names[s]: self.suit.module_ids[row] for s, row in enumerate(rows) if row >= 0}
        self.motion = move_about(dress(self.suit), self.suit.skeleton.name, 1)
        arms = [name for name in self.ids if name.endswith(("upper_arm", "forearm"))]
        self.others = {"pelvis": Ximu3Emulator(self.ids["pelvis"], FIELD_UT)}
        self.others |= {name: WitMotionEmulator(self.ids[name], FIELD_UT) for name in arms}
        self.said = list(self._spoken(seconds))
        """(s, link, bytes) in order of arrival."""

    def _spoken(self, seconds):
        traffic = SuitTraffic(self.motion, SuitSettings(), TYPICAL, 1)
        emulators = {link: MixedSuit(emulator) for link, emulator in self.others.items()}
        for sent in traffic.transmissions(seconds):
            ours = sent.data
            for link, emulator in emulators.items():
                ours, theirs = emulator.feed(ours)
                if theirs:
                    yield sent.time_s, link, theirs
            if ours:
                yield sent.time_s, OWN, ours

    def settings(self, urls, **more):
        def kind(name):
            return "ximu3" if name == "pelvis" else "witmotion"

        links = [{"name": OWN, "url": urls[OWN]}]
        links += [
            {"name": name, "url": urls[name], "carries": kind(name), "module": self.ids[name]}
            for name in self.others
        ]
        return GatewaySettings(gateway="lab", links=links, rig=RIG, reconstructor="independent", **more)


def test_all_are_on_one_clock_and_the_body_moves_as_it_does():
    worn = Worn(SECONDS)
    pipeline = Pipeline.from_settings(
        worn.settings(dict.fromkeys([OWN, *worn.others], "/dev/null")), worn.suit
    )
    for link in pipeline_links(worn):
        pipeline.add_link(*link)
    poses = []
    for at_s, link, data in worn.said:
        chunk = Chunk(data, BEGUN_NS + round(at_s * 1e9), link)
        poses += pipeline.feed(chunk)
    assert unaccounted(pipeline.balances()) == {}
    poses = [pose for pose in poses if pose.time_ns > BEGUN_NS + SETTLED_S * 1e9]
    assert len(poses) > 0.95 * 100 * (SECONDS - SETTLED_S)
    statuses = np.array([pose.status for pose in poses])
    assert (statuses <= Status.HELD).mean() > 0.999
    true = worn.motion.state(np.array([(pose.time_ns - BEGUN_NS) * 1e-9 for pose in poses]))
    errors = orientation_error(np.array([pose.q_wb for pose in poses]), true.q_wb)
    assert np.degrees(np.sqrt(np.nanmedian(errors.inclination**2, axis=0))).max() < 4.0
    figures = [pipeline.modules.records[module].clock.figures() for module in worn.ids.values()]
    assert all(each.is_settled for each in figures)
    assert max(each.sigma_us for each in figures) < 1000


def test_samples_of_all_makers_are_dated_alike():
    """The lateness of a sample, arrival less instant, is the same by whatever maker, to a few ms."""
    worn = Worn(SECONDS)
    settings = worn.settings(dict.fromkeys([OWN, *worn.others], "/dev/null"))
    sources = sources_from_settings(settings, worn.suit)
    for link in pipeline_links(worn):
        sources.add_link(*link)
    late_ms = {module: [] for module in worn.ids.values()}
    for at_s, link, data in worn.said:
        chunk = Chunk(data, BEGUN_NS + round(at_s * 1e9), link)
        for batch in sources.by_link[link].receive(chunk):
            if isinstance(batch, InertialBatch) and at_s > SETTLED_S:
                for sample in batch.samples[np.isfinite(batch.samples["measured"][:, 0, 0])]:
                    late_ms[int(sample["module"])].append((chunk.arrived_ns - int(sample["time_ns"])) * 1e-6)
    medians = {module: np.median(late) for module, late in late_ms.items()}
    others = {worn.ids[name] for name in worn.others}
    ours = np.median([late for module, late in medians.items() if module not in others])
    assert np.abs([medians[module] - ours for module in others]).max() < 3.0, medians


def pipeline_links(worn):
    return [(OWN, "byte_stream"), *((n, "ximu3" if n == "pelvis" else "witmotion") for n in worn.others)]


class Speakers:
    """A TCP server a link, which all begin to speak when the last of them is heard."""

    def __init__(self, worn):
        self.urls, self._servers, self._links = {}, [], [OWN, *worn.others]
        self._said = {link: {} for link in self._links}
        for at_s, link, data in worn.said:
            tick = int(at_s / TICK_S) + 1
            self._said[link][tick] = self._said[link].get(tick, b"") + data
        self._heard = asyncio.Barrier(len(self._links))

    async def __aenter__(self):
        for link in self._links:
            server = await asyncio.start_server(self._speaking(self._said[link]), "127.0.0.1", 0)
            self._servers.append(server)
            self.urls[link] = f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        return self

    async def __aexit__(self, *_):
        for server in self._servers:
            server.close()

    def _speaking(self, said):
        async def speak(_reader, writer):
            loop = asyncio.get_running_loop()
            with contextlib.suppress(ConnectionError, asyncio.CancelledError):
                await self._heard.wait()
                start = loop.time()
                for tick, data in said.items():
                    await asyncio.sleep(max(0.0, start + tick * TICK_S - loop.time()))
                    writer.write(data)
                    await writer.drain()
                await asyncio.sleep(3600)

        return speak


async def test_over_sockets_they_are_recorded_and_replayed_bit_for_bit(tmp_path, mosquitto, until):
    worn = Worn(10.0)
    kept = RecordingSettings(at_start=True, folder=str(tmp_path), min_free_mb=1, warn_free_mb=1)
    async with Speakers(worn) as speakers:
        settings = worn.settings(speakers.urls, mqtt=MqttSettings(port=mosquitto.port), recording=kept)
        service = Service(settings, worn.suit)
        async with running(service):
            await until(lambda: service.pipeline.skeleton_frames >= 500)
            assert unaccounted(service.balances()) == {}
            modules = service.observer.figures().modules
    assert {module.availability for module in modules if module.module in worn.ids.values()} == {"online"}
    recording = open_recording(service.recording.status()["file"])
    assert set(recording.meta.links.values()) == {"byte_stream", "ximu3", "witmotion"}
    assert verify(recording).is_identical
    assert np.isfinite([pose.q_wb for pose in list(recording.skeleton_frames())[300:]]).all()
