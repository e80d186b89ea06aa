"""How the recordings of the golden set were made: emulated sources, each with a seed.

A recipe is run once, when its recording joins the set. The recordings are kept, since emulators may change
while the poses of the same bytes must not. ``RECIPES`` at the end names them all.
"""

from __future__ import annotations

import heapq
import itertools
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from devices import recording_format as fmt
from devices.cameras.heat_map_messages import retimed
from devices.commands.command_client import host_bytes
from devices.emulators import (
    ROUGH,
    TYPICAL,
    BodyMotion,
    Encoding,
    SuitSettings,
    SuitTraffic,
    Transmission,
)
from devices.emulators.gnss_receiver import GnssEmulation, gnss_traffic
from devices.emulators.makers.bno08x import Bno08xEmulator
from devices.emulators.makers.mocopi import mocopi_emulators
from devices.emulators.makers.mti import MtiCanEmulator, MtiEmulator
from devices.emulators.makers.mvn import mvn_emulators
from devices.emulators.makers.slimevr import SlimevrEmulator
from devices.emulators.makers.vendor_emulator import MixedSuit, VendorEmulator
from devices.emulators.makers.witmotion import WitMotionCanEmulator, WitMotionEmulator
from devices.emulators.makers.ximu3 import Ximu3Emulator
from devices.emulators.sensing.light_sampler import Shade
from devices.link import Chunk, Framing, InputEvent, SentChunk
from devices.marker_messages import encode_markers
from devices.recording_writer import DerivedRecordingWriter, session_record
from firmware_protocol import BROADCAST, SamplingTrigger, WireFrame, wire_frame
from gateway.body.body_file import WorldSettings, worn_without_modules
from gateway.body.rig import load_rig
from gateway.body.skeleton import BodyMarkers, CameraPosition, LocalDevice, WornSuit
from gateway.clocks import clock_table, save_clock_table
from gateway.emulation.rig import dress, move, sunlight
from gateway.frames import FloatArray, Quantity
from gateway.pipeline import CALIBRATED_EVENT, LOAD_EVENT, RESET_EVENT
from gateway.reconstruction import OPTICAL
from gateway.recording.snapshot import encode_suit
from gateway.recording.video import video_settings, video_suit
from gateway.service.synchronisation import question
from gateway.settings import AssemblySettings, ClockSettings, GatewaySettings
from gateway.sources.bno08x import Bno08xLinkSettings
from gateway.sources.clock_mode import ClockMode
from gateway.sources.link_settings import LinkSettings
from gateway.sources.mocopi import MocopiLinkSettings
from gateway.sources.module_table import ModuleTable
from gateway.sources.mti import MtiCanLinkSettings, MtiLinkSettings
from gateway.sources.mvn import MvnLinkSettings
from gateway.sources.registry import SOURCES
from gateway.sources.slimevr import SlimevrDevice, SlimevrLinkSettings
from gateway.sources.witmotion import WitMotionCanLinkSettings, WitMotionLinkSettings
from gateway.sources.ximu3 import Ximu3LinkSettings
from tests.seen_walk import CAMERAS, seen_walk

Item = Chunk | SentChunk | InputEvent

BEGUN_NS = 1_800_010_000_000_000_000
"""Gateway time at time 0 of every motion: a winter's day before noon, so that the sun is up."""
FROM_S = 2.0
"""The gateway starts when the body sets off."""
SECONDS = 3.0
FRAME_HZ = 40.0
SLIMEVR_TALK_S = 0.05
"""So often trackers that are to be spoken to are."""
READ_S = 0.004
"""Bytes of a link are read so often."""
SEED = 20
FIELD_UT = 49.0
DEVICE = 60
"""Id of the first local measuring device: the one that a satellite receiver has by default."""
MARKER_HZ = 25.0
VIDEO_HZ = 20.0
SEEN_EVERY = 3
"""Of the walker's instants, which are 60 a second, every third is a picture."""


@dataclass(frozen=True)
class Capture:
    """What a recording holds besides poses."""

    suit: WornSuit
    settings: GatewaySettings
    framings: Mapping[str, str]
    items: Sequence[Item]
    """In the order in which a gateway would have handled them."""
    clock_table: str | None = None


def write_capture(path: Path, capture: Capture) -> None:
    """Write the recording, without poses. Raises ``RecordingError`` when it exists."""
    attachments = {
        fmt.SUIT: json.dumps(json.loads(encode_suit(capture.suit)), separators=(",", ":")).encode(),
        fmt.SETTINGS: capture.settings.model_dump_json().encode(),
    }
    if capture.clock_table is not None:
        attachments[fmt.CLOCK_TABLE] = capture.clock_table.encode()
    session = session_record(
        capture.framings, session=path.stem, name=path.stem, begun_ns=str(BEGUN_NS), from_start="1"
    )
    with DerivedRecordingWriter(path, session, attachments, BEGUN_NS) as writer:
        for item in capture.items:
            if isinstance(item, InputEvent):
                writer.add(fmt.EVENTS, item.time_ns, json.dumps(item._asdict()).encode())
            elif isinstance(item, Chunk):
                writer.add_chunk(item, capture.framings[item.link])
            else:
                link = {"link": item.link, "framing": capture.framings[item.link]}
                writer.add(fmt.SENT + item.link, item.sent_ns, item.data, link)


# What the recipes are made of.


def _link(name: str, carries: str = "suit") -> LinkSettings:
    return SOURCES[carries].settings(name=name, url="/dev/null", carries=carries)


def _settings(*links: LinkSettings, **more: Any) -> GatewaySettings:
    chosen = {"rig": "golden", "reconstructor": "joint", "assembly": AssemblySettings(rate_hz=FRAME_HZ)}
    return GatewaySettings(gateway="golden", links=links, **(chosen | more))


def _worn_settings(suit: WornSuit, **more: Any) -> SuitSettings:
    return SuitSettings(gravity=suit.gravity, magnetic_field=suit.magnetic_field, **more)


def _moving(suit: WornSuit) -> BodyMotion:
    return move(dress(suit), suit.skeleton.name, SEED)


def _instant_ns(at_s: float) -> int:
    return BEGUN_NS + round(at_s * 1e9)


def _reads(transmissions: Iterable[Transmission], link: str, from_s: float = FROM_S) -> Iterator[Chunk]:
    """Chunks as a reader gets them that looks every ``READ_S``, and wakes up with the last byte."""
    heard = (sent for sent in transmissions if sent.time_s >= from_s)
    for _, group in itertools.groupby(heard, key=lambda sent: int(sent.time_s / READ_S)):
        sent = list(group)
        yield Chunk(b"".join(each.data for each in sent), _instant_ns(sent[-1].time_s), link)


def _cut(chunks: Iterable[Chunk], rng: np.random.Generator) -> Iterator[Chunk]:
    """The same bytes cut anywhere, as a serial port cuts them."""
    kept = b""
    for chunk in chunks:
        data = kept + chunk.data
        end = len(data) - int(rng.integers(0, 12))
        yield replace(chunk, data=data[:end])
        kept = data[end:]


def _conversation(
    traffic: SuitTraffic,
    link: str,
    until_s: float,
    frame_of: Callable[[int, int], WireFrame],
    interval_s: float,
) -> Iterator[Item]:
    """A host that says something at even intervals; frame_of: of how many went before, and of the instant."""
    for k in range(int((until_s - FROM_S) / interval_s)):
        at_s = FROM_S + k * interval_s
        yield from _reads(traffic.advance(at_s), link)
        data = host_bytes(frame_of(k, _instant_ns(at_s)), traffic.framing)
        yield SentChunk(data, _instant_ns(at_s), link)
        traffic.receive(data, at_s)
    yield from _reads(traffic.advance(until_s), link)


def _time_ns(item: Item) -> int:
    if isinstance(item, Chunk):
        return item.arrived_ns
    return item.sent_ns if isinstance(item, SentChunk) else item.time_ns


def _merged(*streams: Iterable[Item]) -> list[Item]:
    return list(heapq.merge(*streams, key=_time_ns))


def _event(at_s: float, name: str, **data: Any) -> InputEvent:
    return InputEvent(name, data, _instant_ns(at_s))


def _with_devices(suit: WornSuit, *devices: LocalDevice) -> WornSuit:
    return replace(suit, local_devices=devices)


def _position_device(segment: int = 0) -> LocalDevice:
    return LocalDevice(Quantity.POSITION, segment, np.array([0.02, 0.05, 0.0]), DEVICE)


# Modules.


def serial(seconds: float) -> Capture:
    """A pendulum over a serial port that cuts frames anywhere; modules are asked for their time; a reset."""
    suit, until_s = load_rig("pendulum_3"), FROM_S + seconds
    traffic = SuitTraffic(_moving(suit), _worn_settings(suit), TYPICAL, SEED)
    said = list(_conversation(traffic, "serial", until_s, question, 0.25))
    rng = np.random.default_rng(SEED)
    cut = iter(list(_cut((item for item in said if isinstance(item, Chunk)), rng)))
    items = [next(cut) if isinstance(item, Chunk) else item for item in said]
    reset = _event(FROM_S + 0.6 * seconds, RESET_EVENT, kind="heading", facing=0.5)
    return Capture(suit, _settings(_link("serial")), {"serial": Framing.BYTE_STREAM}, _merged(items, [reset]))


def can(seconds: float) -> Capture:
    """A robot arm on a poor CAN bus: losses, damage, repeats; wild values taken out; modules remounted."""
    suit, until_s = load_rig("robot_arm_4"), FROM_S + seconds
    settings = _worn_settings(suit, encoding=Encoding(Framing.CAN), is_fine=True)
    traffic = SuitTraffic(_moving(suit), settings, ROUGH, SEED)
    turn = Rotation.from_rotvec([0.0, 0.02, 0.03]).as_quat(scalar_first=True).tolist()
    mounting = {"link_3": {"sensor_to_segment": turn, "position": [0.028, 0.001, 0.102]}}
    calibrated = _event(FROM_S + 0.5 * seconds, CALIBRATED_EVENT, modules=mounting)
    chosen = _settings(_link("can"), assembly=AssemblySettings(rate_hz=FRAME_HZ, despike=True))
    chunks = _reads(traffic.transmissions(until_s), "can")
    return Capture(suit, chosen, {"can": Framing.CAN}, _merged(chunks, [calibrated]))


def relay(seconds: float) -> Capture:
    """A chain behind a relay, modules of one clock and two rates; where its root is, a device measures."""
    suit, until_s = load_rig("chain_5"), FROM_S + seconds
    one_clock = replace(TYPICAL, clock_skew_ppm=0.0, has_random_clock_start=False)
    slower = {suit.module_ids[2]: 60.0}
    settings = _worn_settings(suit, has_relay=True, has_card=False, module_rates_hz=slower)
    traffic = SuitTraffic(_moving(suit), settings, one_clock, SEED)
    chosen = _settings(_link("relay"), clock=ClockSettings(mode=ClockMode.SHARED))
    chunks = list(_reads(traffic.transmissions(until_s), "relay"))
    return Capture(suit, chosen, {"relay": Framing.BYTE_STREAM}, chunks)


def trigger(seconds: float) -> Capture:
    """An arm whose modules sample when they are told to; for a while every second frame is left out."""
    suit, until_s = load_rig("arm_3"), FROM_S + seconds
    traffic = SuitTraffic(_moving(suit), _worn_settings(suit, mode=3), TYPICAL, SEED)

    def told(k: int, now_ns: int) -> WireFrame:
        return wire_frame(SamplingTrigger(k), BROADCAST, k, now_ns // 1000 % 2**32)

    said = _conversation(traffic, "radio", until_s, told, 0.01)
    loads = [
        _event(FROM_S + share * seconds, LOAD_EVENT, stage=stage, solve_every=every)
        for share, stage, every in ((0.6, "HALF", 2), (0.7, "ALL", 1))
    ]
    chosen = _settings(_link("radio"), clock=ClockSettings(mode=ClockMode.TRIGGER))
    return Capture(suit, chosen, {"radio": Framing.BYTE_STREAM}, _merged(said, loads))


def devices(seconds: float) -> Capture:
    """A chain with what measures acceleration, velocity and air speed, each on a segment of its own."""
    tubes = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])
    place = np.array([0.01, 0.0, 0.03])
    suit = _with_devices(
        load_rig("chain_5"),
        LocalDevice(Quantity.VELOCITY, 0, place, DEVICE),
        LocalDevice(Quantity.ACCELERATION, 2, place, DEVICE + 1),
        LocalDevice(Quantity.AIR_VELOCITY, 4, place, DEVICE + 2, tubes),
    )
    traffic = SuitTraffic(_moving(suit), _worn_settings(suit), TYPICAL, SEED)
    chunks = list(_reads(traffic.transmissions(FROM_S + seconds), "suit"))
    return Capture(suit, _settings(_link("suit")), {"suit": Framing.BYTE_STREAM}, chunks)


def walking(seconds: float) -> Capture:
    """Legs that walk through the world."""
    suit = load_rig("suit_lower_7")
    traffic = SuitTraffic(_moving(suit), _worn_settings(suit), TYPICAL, SEED)
    chunks = list(_reads(traffic.transmissions(FROM_S + seconds), "suit"))
    return Capture(suit, _settings(_link("suit")), {"suit": Framing.BYTE_STREAM}, chunks)


def fused(seconds: float) -> Capture:
    """An arm whose modules fuse on board; their rates stand in a table."""
    suit = load_rig("arm_3")
    settings = _worn_settings(suit, mode=1, sampling_rate_hz=FRAME_HZ)
    traffic = SuitTraffic(_moving(suit), settings, TYPICAL, SEED)
    counts = {module: [1.0 + sender.clock.skew] for module, sender in traffic.senders.items()}
    chunks = list(_reads(traffic.transmissions(FROM_S + seconds), "suit"))
    clock = ClockSettings(mode=ClockMode.TABLE, table=fmt.CLOCK_TABLE)
    chosen = _settings(_link("suit"), reconstructor="fused", clock=clock)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / fmt.CLOCK_TABLE
        save_clock_table(clock_table([counts]), path)
        return Capture(suit, chosen, {"suit": Framing.BYTE_STREAM}, chunks, path.read_text())


# Modules and something beside them.


def _beside_gnss(seconds: float, kind: str) -> Capture:
    suit, until_s = _with_devices(load_rig("arm_3"), _position_device()), FROM_S + seconds
    arm = suit.local_devices[0].position
    motion = _moving(_with_devices(suit))
    traffic = SuitTraffic(motion, _worn_settings(suit), TYPICAL, SEED)

    def place(at_s: float) -> tuple[FloatArray, FloatArray]:
        state = motion.state(np.array([at_s - 1e-3, at_s, at_s + 1e-3]))
        places = state.joint_position[:, 0] + state.R_wb[:, 0] @ arm
        return places[1], (places[2] - places[0]) / 2e-3

    emulation = GnssEmulation(kind=kind, dropout=(until_s - 1.0, until_s - 0.5))
    fixes = itertools.takewhile(
        lambda sent: sent.time_s < until_s, gnss_traffic(place, BEGUN_NS, emulation, SEED)
    )
    items = _merged(_reads(traffic.transmissions(until_s), "suit"), _reads(fixes, "gnss"))
    framings = {"suit": Framing.BYTE_STREAM, "gnss": "gnss"}
    return Capture(suit, _settings(_link("suit"), _link("gnss", "gnss")), framings, items)


def gnss_nmea(seconds: float) -> Capture:
    """An arm on somebody with a satellite receiver, which loses sight for half a second."""
    return _beside_gnss(seconds, "nmea")


def gnss_ubx(seconds: float) -> Capture:
    """The same in the other language of receivers."""
    return _beside_gnss(seconds, "ubx")


def _in_the_sun(seconds: float, beside_magnetometer: bool) -> Capture:
    suit = load_rig("robot_arm_4_sun")
    assert suit.sun is not None
    suit = replace(suit, sun=replace(suit.sun, beside_magnetometer=beside_magnetometer))
    light = sunlight(suit, BEGUN_NS)
    assert light is not None
    cloud = Shade(FROM_S + 0.6 * seconds, FROM_S + 0.7 * seconds, direct=0.1, sky=1.5)
    settings = _worn_settings(suit, sunlight=replace(light, shades=(cloud,)))
    traffic = SuitTraffic(_moving(suit), settings, TYPICAL, SEED)
    chunks = list(_reads(traffic.transmissions(FROM_S + seconds), "suit"))
    return Capture(suit, _settings(_link("suit")), {"suit": Framing.BYTE_STREAM}, chunks)


def light(seconds: float) -> Capture:
    """A robot arm outdoors whose headings come from the sun; a cloud passes."""
    return _in_the_sun(seconds, False)


def light_and_field(seconds: float) -> Capture:
    """The same with its magnetometers."""
    return _in_the_sun(seconds, True)


def hips(seconds: float) -> Capture:
    """Legs at rest; cameras see where the hips are."""
    seen, _ = seen_walk(1)
    position = CameraPosition(video_suit(CAMERAS, "full", seen), DEVICE, 0.02, 40_000_000, np.pi / 2)
    suit = _with_devices(load_rig("suit_lower_7"), LocalDevice(Quantity.POSITION, 0, np.zeros(3), DEVICE))
    suit = replace(suit, camera_position=position)
    traffic = SuitTraffic(_moving(_with_devices(suit)), _worn_settings(suit), TYPICAL, SEED)
    until_s = min(seconds, FROM_S)
    n_pictures = round(until_s * VIDEO_HZ)
    items = _merged(
        _reads(traffic.transmissions(until_s), "suit", from_s=0.0),
        _pictures(seen * n_pictures, 0.04),
    )
    framings = {"suit": Framing.BYTE_STREAM, "cameras": "heat_maps"}
    return Capture(suit, _settings(_link("suit"), _link("cameras", "heat_maps")), framings, items)


def ximu3(seconds: float) -> Capture:
    """An arm whose hand wears an x-IMU3, on a link of its own."""
    suit, until_s = load_rig("arm_3"), FROM_S + seconds
    module = suit.module_ids[-1]
    items = _partly_of_others(suit, until_s, {"hand": Ximu3Emulator(module, FIELD_UT)})
    device = Ximu3LinkSettings(name="hand", url="/dev/null", module=module, field_ut=FIELD_UT)
    framings = {"suit": Framing.BYTE_STREAM, "hand": "ximu3"}
    return Capture(suit, _settings(_link("suit"), device), framings, items)


def synchronised(seconds: float) -> Capture:
    """An arm of three x-IMU3 that keep their clocks together, over links that delay them differently."""
    suit, until_s = load_rig("arm_3"), FROM_S + seconds
    together = replace(TYPICAL, clock_skew_ppm=0.0, has_random_clock_start=False)
    worn = replace(_worn_settings(suit), emulator=lambda module: Ximu3Emulator(module, FIELD_UT))
    names = dict(zip(suit.module_ids, ("trunk", "arm", "hand"), strict=True))
    longer_ns = {name: place * 4_000_000 for place, name in enumerate(names.values())}
    spoken = SuitTraffic(_moving(suit), worn, together, SEED).transmissions(until_s)
    items = [
        Chunk(sent.data, BEGUN_NS + round(sent.time_s * 1e9) + longer_ns[name], name)
        for sent in spoken
        if sent.device is not None and sent.time_s >= FROM_S
        for name in (names[sent.device],)
    ]
    items.sort(key=lambda chunk: chunk.arrived_ns)
    links = [
        Ximu3LinkSettings(name=name, url="/dev/null", module=module, field_ut=FIELD_UT)
        for module, name in names.items()
    ]
    chosen = _settings(*links, clock=ClockSettings(mode=ClockMode.SYNCHRONISED))
    return Capture(suit, chosen, dict.fromkeys(names.values(), "ximu3"), items)


def makers(seconds: float) -> Capture:
    """An arm with a module of our own, an MTi on a serial line and another on a CAN bus."""
    suit, until_s = load_rig("arm_3"), FROM_S + seconds
    _, arm, hand = suit.module_ids
    others = {"arm": MtiEmulator(arm, FIELD_UT), "hand": MtiCanEmulator(hand, FIELD_UT)}
    links = [
        MtiLinkSettings(name="arm", url="/dev/null", module=arm, field_ut=FIELD_UT),
        MtiCanLinkSettings(name="hand", url="/dev/null", module=hand, field_ut=FIELD_UT),
    ]
    items = _partly_of_others(suit, until_s, others)
    framings = {"suit": Framing.BYTE_STREAM, **{link.name: link.carries for link in links}}
    return Capture(suit, _settings(_link("suit"), *links), framings, items)


def unstamped(seconds: float) -> Capture:
    """An arm with a module of our own, a WitMotion on a serial line and another on a CAN bus: no stamps."""
    suit, until_s = load_rig("arm_3"), FROM_S + seconds
    _, arm, hand = suit.module_ids
    others = {"arm": WitMotionEmulator(arm, FIELD_UT), "hand": WitMotionCanEmulator(hand, FIELD_UT)}
    links = [
        WitMotionLinkSettings(name="arm", url="/dev/null", module=arm),
        WitMotionCanLinkSettings(name="hand", url="/dev/null", module=hand),
    ]
    items = _partly_of_others(suit, until_s, others)
    framings = {"suit": Framing.BYTE_STREAM, **{link.name: link.carries for link in links}}
    return Capture(suit, _settings(_link("suit"), *links), framings, items)


def fused_elsewhere(seconds: float) -> Capture:
    """An arm of a BNO08x, a segment of MVN and a bone of mocopi."""
    suit, until_s = load_rig("arm_3"), FROM_S + seconds
    trunk, arm, hand = suit.module_ids
    others = {
        "trunk": Bno08xEmulator(trunk, FIELD_UT),
        "arm": mvn_emulators([arm], FIELD_UT)[arm],
        "hand": mocopi_emulators([hand], FIELD_UT)[hand],
    }
    links = [
        Bno08xLinkSettings(name="trunk", url="/dev/null", module=trunk),
        MvnLinkSettings(name="arm", url="udp://0.0.0.0:9763"),
        MocopiLinkSettings(name="hand", url="udp://0.0.0.0:12351"),
    ]
    fused_on_board = _worn_settings(suit, mode=1, sampling_rate_hz=100.0)
    items = _partly_of_others(suit, until_s, others, fused_on_board)
    chosen = _settings(*links, reconstructor="fused")
    return Capture(suit, chosen, {link.name: link.carries for link in links}, items)


def slimevr(seconds: float) -> Capture:
    """An arm of three SlimeVR trackers, greeted and pinged by the gateway."""
    suit, until_s = load_rig("arm_3"), FROM_S + seconds
    emulators = {module: SlimevrEmulator(module, FIELD_UT) for module in suit.module_ids}
    worn = replace(_worn_settings(suit), emulator=emulators.__getitem__)
    traffic = SuitTraffic(_moving(suit), worn, TYPICAL, SEED)
    trackers = {emulator.mac: module for module, emulator in emulators.items()}
    link = SlimevrLinkSettings(name="trackers", url="udp://0.0.0.0:6969", trackers=trackers)
    device, modules = SlimevrDevice(link), ModuleTable()
    modules.add_link(link.name)
    items: list[Item] = []
    for step in range(1, round(until_s / SLIMEVR_TALK_S) + 1):
        at_s = step * SLIMEVR_TALK_S
        for sent in traffic.advance(at_s):
            sender = f"10.0.0.{sent.device}:4210"
            items.append(Chunk(sent.data, _instant_ns(sent.time_s), link.name, sender))
            for message in device.feed(items[-1]):
                device.sample(message, modules, items[-1])
        for data, to in device.due(_instant_ns(at_s)):
            items.append(SentChunk(data, _instant_ns(at_s), link.name))
            traffic.receive(data, at_s, int(to.partition(":")[0].rpartition(".")[2]))
    return Capture(suit, _settings(link), {link.name: "slimevr"}, items)


def _partly_of_others(
    suit: WornSuit, until_s: float, others: Mapping[str, VendorEmulator], worn: SuitSettings | None = None
) -> list[Item]:
    """What a suit sends of which some modules speak as other makers' do, by the names of their links."""
    traffic = SuitTraffic(_moving(suit), worn or _worn_settings(suit), TYPICAL, SEED)
    spoken = {link: MixedSuit(emulator) for link, emulator in others.items()}
    items: list[Item] = []
    for chunk in _reads(traffic.transmissions(until_s), "suit"):
        ours = chunk.data
        for link, speaking in spoken.items():
            ours, theirs = speaking.feed(ours)
            items += [replace(chunk, data=theirs, link=link)] if theirs else []
        items += [replace(chunk, data=ours)] if ours else []
    return items


# No modules.


def _seen_by_an_optical_system(
    rig: str, times: FloatArray, hidden: slice, swapped: Sequence[int], nameless: int
) -> Capture:
    """Somebody with four markers a segment at motion times (F,), s; in the middle of the trial some markers
    are hidden and one has no name, after it two have each other's for a while."""
    worn, rng = load_rig(rig), np.random.default_rng(SEED)
    segments = np.repeat(np.arange(worn.skeleton.n_segments), 4)
    places = rng.normal(0.0, 0.08, (len(segments), 3))
    labels = tuple(f"m{i}" for i in range(len(segments)))
    on_body = BodyMarkers(labels, segments, places, np.full(len(segments), 0.004))
    state = _moving(worn).state(times)
    seen = state.joint_position[:, segments] + np.einsum("fmij,mj->fmi", state.R_wb[:, segments], places)
    seen += rng.normal(0.0, 0.001, seen.shape)
    first, then = (round(share * len(times)) for share in (0.4, 0.6))
    seen[first:then, hidden] = np.nan
    seen[then + 2 : then + 6, swapped] = seen[then + 2 : then + 6, swapped[::-1]]
    lost = seen[:, nameless].copy()
    seen[first:then, nameless] = np.nan
    chunks = []
    for f, at_s in enumerate((times - times[0]).tolist()):
        others = lost[f : f + 1] if first <= f < then else ()
        arrived_ns = _instant_ns(float(times[f]) + 0.005 + 0.002 * float(rng.random()))
        message = encode_markers(f, None, labels, seen[f], others, time_s=at_s)
        chunks.append(Chunk(message, arrived_ns, "markers"))
    assembly = AssemblySettings(rate_hz=MARKER_HZ)
    settings = _settings(_link("markers", "markers"), reconstructor=OPTICAL, assembly=assembly)
    suit = worn_without_modules(worn.skeleton, on_body, WorldSettings())
    return Capture(suit, settings, {"markers": "markers"}, chunks)


def markers(seconds: float) -> Capture:
    """Legs that walk; a shank and most of a foot are hidden for a while."""
    times = FROM_S + np.arange(round(seconds * MARKER_HZ)) / MARKER_HZ
    return _seen_by_an_optical_system("suit_lower_7", times, slice(8, 15), [16, 20], 27)


def few_markers(seconds: float) -> Capture:
    """An arm for a moment: for what takes half a second a pose."""
    times = 2.0 * FROM_S + np.arange(max(round(0.13 * seconds * MARKER_HZ), 3)) / MARKER_HZ
    return _seen_by_an_optical_system("arm_3", times, slice(4, 6), [8, 9], 11)


def _pictures(instants: Sequence[Sequence[bytes]], latency_s: float) -> Iterator[Chunk]:
    """What the cameras send of these instants, ``VIDEO_HZ`` a second: each camera a little later."""
    for k, instant in enumerate(instants):
        at_s = k / VIDEO_HZ
        for c, message in enumerate(instant):
            arrived_ns = _instant_ns(at_s + latency_s + 0.001 * c)
            yield Chunk(retimed(message, k, round(at_s * 1e9)), arrived_ns, "cameras")


def heat_maps(seconds: float) -> Capture:
    """Somebody who walks past three cameras."""
    n_pictures = max(round(0.27 * seconds * VIDEO_HZ), 4)
    seen = seen_walk(SEEN_EVERY * n_pictures)[0][::SEEN_EVERY]
    suit = video_suit(CAMERAS, "full", seen)
    settings = video_settings("golden", VIDEO_HZ, "golden")
    return Capture(suit, settings, {"cameras": "heat_maps"}, list(_pictures(seen, 0.02)))


RECIPES: dict[str, Callable[[float], Capture]] = {
    recipe.__name__: recipe
    for recipe in (
        serial, can, relay, trigger, devices, walking, fused,
        gnss_nmea, gnss_ubx, light, light_and_field, hips, ximu3, synchronised, makers,
        unstamped, fused_elsewhere, slimevr, markers, few_markers, heat_maps,
    )
}  # fmt: skip
"""By the name of the recording; the argument: how long it lasts, s."""
