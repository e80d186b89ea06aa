"""What is known to be good, for every target, and what becomes of it by small damage."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

import firmware_protocol
from benchmarks.fuzzing.mutants import mutants
from benchmarks.fuzzing.targets import ROOT, Target
from benchmarks.fuzzing.vendor_seeds import of_vendors
from devices.emulators.faults.makers_campaign import LANGUAGES
from devices.link import Chunk, Framing
from devices.marker_messages import encode_markers
from devices.recording_file import RecordingFile
from devices.recording_format import HOST
from devices.recording_writer import RecordingWriter, session_record
from devices.vendor_protocols import slimevr
from devices.vendor_protocols.mti import encode_can
from devices.vendor_protocols.mvn import JOINT_ANGLES, META, JointRotation, encode_scale, encode_text
from devices.vendor_protocols.mvn import encode as encode_mvn
from devices.vendor_protocols.witmotion import REGISTERS, UNLOCK, encode_write
from devices.vendor_protocols.witmotion import encode as encode_packet
from devices.vendor_protocols.ximu3 import Announcement, encode_announcement
from firmware_protocol import CanFrame, pack_can_records
from firmware_protocol.device_settings import factory_settings
from firmware_protocol.flash_slots import encode_slot
from gateway.body.rig import load_rig
from gateway.contract.messages import BridgeInfo, BridgeState, ModuleInfo, describe_body
from gateway.contract.topics import Topics
from gateway.frames import SkeletonFrame
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.pose_encoding import PosePublications
from gateway.outputs.settings import MqttSettings, PoseMap
from gateway.recording.pose_encoding import encode_skeleton_frame
from gateway.recording.snapshot import attachments_of
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings
from gateway.support.settings_files import shipped_folder

_VECTORS = Path(firmware_protocol.__file__).parent / "vectors"
_RIG = "arm_4"
_EVENTS: dict[str, dict[str, Any]] = {
    "reset": {"kind": "heading", "facing": 0.0},
    "load": {"stage": "side_outputs", "solve_every": 1},
    "link": {"link": "suit", "state": "down", "reason": "gone"},
}
_GATEWAY = b"""gateway: g
links: [{name: a, url: 'tcp://h:1'}]
rig: arm_4
mqtt: {tls: {}, include: [sigma]}
"""


def seeds(target: Target) -> list[bytes]:
    """Return good inputs of a target, none larger than it takes."""
    return [data for data in _MAKERS[target.place]()[target.name] if len(data) <= target.largest]


def generated(target: Target) -> Iterator[tuple[str, bytes]]:
    """Yield the seeds of a target and damaged ones, the same ones every time, each with a name."""
    good = seeds(target)
    yield from ((f"seed {number}", data) for number, data in enumerate(good))
    yield from (
        (f"mutant {number}", data)
        for number, data in enumerate(mutants(good, target.largest, target.name, target.mutants))
    )


def _vectors(name: str) -> list[dict[str, Any]]:
    vectors: list[dict[str, Any]] = json.loads((_VECTORS / f"{name}.json").read_text())["vectors"]
    return vectors


_REGISTERS = [encode_packet(REGISTERS, (9, 6, 0, 0)), encode_write(*UNLOCK)]
_MVN_DATAGRAMS = [
    encode_text(META, 1, 10, "name:A\n"),
    encode_scale(1, 10, {"pelvis": (0.0, 0.0, 1.0)}),
    encode_mvn(JOINT_ANGLES, 1, 10, [JointRotation(1, 2, (1.0, 2.0, 3.0))]),
]
_ANNOUNCED = encode_announcement(Announcement("Hand", "64F0EDBF", "10.0.0.7", 7000, 8001, 9000, 87, 70))


_TRACKER = slimevr.Handshake(22, "0.7", "a4e57c000001")
_SLIMEVR = [
    slimevr.encode(slimevr.Kind.HANDSHAKE, 0, slimevr.handshake(_TRACKER)),
    slimevr.GREETING,
    slimevr.ping(7),
    slimevr.set_setting(0, slimevr.MAGNETOMETER, True),
    slimevr.acknowledge(0, 1),
]


def _messages(language: str) -> list[bytes]:
    """Messages of another maker's protocol, alone and in a row."""
    rng = Random(1)
    messages = [LANGUAGES[language].message(rng, number) for number in range(9)]
    return [*messages, b"".join(messages)]


def _of_the_wire() -> dict[str, list[bytes]]:
    packets, asked = _vectors("packets"), _vectors("commands")
    streams = [bytes.fromhex(each["byte_stream"]) for each in packets]
    buses = [_can(each["can_classic"]["frames"]) for each in packets if each["can_classic"]]
    slot = encode_slot(7, factory_settings())
    return {
        "wire_stream": [*streams, b"".join(streams[:8])],
        "ximu3_stream": [*_messages("ximu3"), *_messages("ximu3_text"), _ANNOUNCED],
        "witmotion_stream": [*_messages("witmotion"), *_messages("witmotion_can"), *_REGISTERS],
        "suit_datagrams": [
            *_messages("mvn"),
            *_messages("mocopi"),
            *_messages("bno08x_rvc"),
            *_MVN_DATAGRAMS,
        ],
        "mti_stream": [*_messages("mti"), encode_can({"sample_time_us": (7,), "acceleration": (0, 0, 9.75)})],
        "slimevr_datagrams": [*_messages("slimevr")[:9], *_SLIMEVR],
        "can_stream": [*buses, b"".join(buses[:4])],
        "slcan_text": [b"T0c400c4081100d01213000d05\rt1232ab01\rd1239" + b"00" * 12 + b"\r\x07V1013\r"],
        "can_transfers": [bytes([1, 0]) + bytes.fromhex(each["body"])[:14] for each in packets],
        "commands": [
            bytes([each["verb"]]) + bytes.fromhex(each[part]["bytes"])
            for each in asked
            for part in ("arguments", "payload")
            if each.get(part)
        ]
        + [bytes([each["kind"]]) + bytes.fromhex(each["body"]) for each in packets],
        "flash_slots": [slot + slot, slot[:-1] + slot],
        "gnss": _satellites(),
        "markers": [
            encode_markers(1, 5, ["A", "B"], [[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]], [[0.5, 0.5, 0.5]]),
            b'{"sequence": 2, "time_s": 0.5, "unit": "mm", "markers": {"A": [1, 2, 3], "B": null}}\n',
        ],
        "card_file": [b"".join(streams), streams[0]],
    }


def _can(frames: list[dict[str, Any]]) -> bytes:
    return pack_can_records(
        CanFrame(int(each["identifier"], 16), bytes.fromhex(each["data"])) for each in frames
    )


def _satellites() -> list[bytes]:
    sentences = (
        "GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,",
        "GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W",
        "GPGST,123519,1.5,2.0,1.0,30.0,1.1,1.2,2.3",
    )
    lines = []
    for text in sentences:
        check = 0
        for letter in text.encode():
            check ^= letter
        lines.append(f"${text}*{check:02X}\r\n".encode())
    body = b"\x01\x07\x5c\x00" + bytes(92)
    first = second = 0
    for value in body:
        first = (first + value) & 255
        second = (second + first) & 255
    ubx = b"\xb5\x62" + body + bytes([first, second])
    return [*lines, b"".join(lines), ubx, ubx + lines[0]]


def _of_files() -> dict[str, list[bytes]]:
    config = shipped_folder()

    def texts(*paths: Path) -> list[bytes]:
        return [path.read_bytes() for path in paths]

    return {
        "gateway_file": [*texts(*sorted(config.glob("*.yaml")), *(ROOT / "docker").glob("*.yaml")), _GATEWAY],
        "rig_file": texts(*sorted((config / "rigs").glob("*.yaml"))),
        "body_file": texts(*sorted((config / "bodies").glob("*.yaml"))),
        "clock_table": list(_clock_tables()),
        "urdf": texts(ROOT / "tests" / "data" / "arm6.urdf"),
        "map_file": [
            b"00B42279: pelvis\n00B42268: thorax\n",
            b'<x><ExperimentalSensor name="_00B42279"><name_in_model>pelvis_imu</name_in_model>'
            b"</ExperimentalSensor></x>",
        ],
    }


def _clock_tables() -> Iterator[bytes]:
    """Good ones, and one for every way in which a table is refused."""
    table = "reference: {}\ninterval_s: {}\nrepetitions: 2\nranking: {}\nalpha: {}\n"
    rows = "{1: [1.0, 1.0], 2: [0.9999, 0.99995]}"
    for reference, interval_s, ranking, alpha in (
        (1, 1.0, "[1, 2]", rows),
        (2, 60.0, "[2, 1]", "{1: [1.0001], 2: [1.0]}"),
        (3, 1.0, "[1, 2]", rows),
        (1, 1.0, "[1, 3]", rows),
        (1, 0.0, "[1, 2]", rows),
        (1, 1.0, "[1, 2]", "{1: [1.0], 2: [1.0, 1.0]}"),
        (1, 1.0, "[1, 2]", "{1: [0.5], 2: [1.0]}"),
        (1, 1.0, "[1]", "{1: []}"),
    ):
        yield table.format(reference, interval_s, ranking, alpha).encode()


def _frame(sequence: int) -> SkeletonFrame:
    n = load_rig(_RIG).skeleton.n_segments
    return SkeletonFrame(
        sequence=sequence,
        time_ns=10 * sequence,
        q_wb=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        angular_rate=np.zeros((n, 3)),
        joint_acceleration=np.zeros((n, 3)),
        p_w=np.full((n, 3), np.nan),
        sigma=np.zeros(n),
        status=np.zeros(n, np.uint8),
        root=0,
    )


def _of_recordings() -> dict[str, list[bytes]]:
    suit = load_rig(_RIG)
    settings = GatewaySettings(links=[LinkSettings(name="suit", url="tcp://127.0.0.1:1")], rig=_RIG)
    attachments = {**attachments_of(settings, suit), HOST: b'{"python": "3.11"}'}  # the same on every machine
    whole, bare = _recording(attachments), _recording({})
    cut = [whole[:-8], whole[: len(whole) // 2], bare[:-40]]
    spoilt = whole[:200] + b"\xff\xff\xff\x7f" + whole[204:]
    return {
        "recording": [whole, bare, *cut, spoilt],
        "recorded_suit": [attachments["suit.json"].replace(b"\n", b"").replace(b"  ", b"")],
        "recorded_frame": [encode_skeleton_frame(_frame(1))],
    }


def _recording(attachments: Mapping[str, bytes]) -> bytes:
    """Two links, something of every kind, and two MCAP chunks."""
    links = {"suit": Framing.BYTE_STREAM, "bus": Framing.CAN}
    session = session_record(links, session="s", part="1", begun_ns="0", name="seed")
    packet = _vectors("packets")[0]
    chunks = {"suit": bytes.fromhex(packet["byte_stream"]), "bus": _can(packet["can_classic"]["frames"])}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "seed.mcap"
        with RecordingWriter(path, session, attachments, 0) as writer:
            for k in (1, 2):
                for name, framing in links.items():
                    writer.add_chunk(Chunk(chunks[name], 5 * k, name), framing)
                writer.add("/sent/suit", 6 * k, chunks["suit"], {"link": "suit"})
                writer.add("/skeleton", 10 * k, encode_skeleton_frame(_frame(k)), {})
                for name, data in _EVENTS.items():
                    event = {"time_ns": 11 * k, "name": name, "data": data}
                    writer.add("/events", 11 * k, json.dumps(event).encode(), {})
                writer.add("/statistics", 12 * k, b'{"modules": {"1": {"received": 5, "lost": 1}}}', {})
                writer.flush()
        RecordingFile(path)
        return path.read_bytes()


def _requests() -> Iterator[bytes]:
    asked: Iterable[tuple[str, str]] = (
        ("gateway/health", ""),
        ("gateway/reload", "{}"),
        ("recording/start", '{"name": "../x", "transaction": 1}'),
        ("recording/stop", '{"transaction": "a"}'),
        ("modules/set", '{"device": "3", "settings": {"rate_hz": 100}}'),
        ("modules/card_read", '{"file": 1, "offset": 0, "length": 100}'),
        ("calibration/step", '{"step": "stand", "countdown_s": 1}'),
        ("reset/heading", '{"facing_deg": 90}'),
    )
    for verb, payload in asked:
        yield f"{verb}\n\n{payload}".encode()
    yield b"gateway/info\nmy/answers\n{}"


def _published() -> list[bytes]:
    """What a gateway publishes, in the order of ``requests._TOPICS``."""
    suit = load_rig(_RIG)
    frame = replace(_frame(1), p_w=np.zeros((suit.skeleton.n_segments, 3)))
    everything = MqttSettings(include=frozenset(PoseMap))
    poses = PosePublications(everything, suit.skeleton, Topics("mocap", "g"))
    modules = tuple(ModuleInfo(module=module, segment=f"s{module}") for module in suit.module_ids)
    info = BridgeInfo(
        version="0", gateway="g", reconstructor="independent", frame_rate=100.0, modules=modules
    )
    health = MqttOutput(everything, suit.skeleton, info).health()
    health = health.model_copy(update={"t_ns": 1, "instance": "0", "uptime_s": 1.0})
    return [
        poses.of(frame)[0].payload,
        BridgeState(state="online").payload(),
        info.payload(),
        health.payload(),
        describe_body(suit.skeleton).payload(),
    ]


def _of_requests() -> dict[str, list[bytes]]:
    return {
        "requests": list(_requests()),
        "published": [bytes([n]) + text for n, text in enumerate(_published())],
    }


_MAKERS: dict[str, Callable[[], dict[str, list[bytes]]]] = {
    "wire": _of_the_wire,
    "configuration": _of_files,
    "recordings": _of_recordings,
    "vendors": of_vendors,
    "requests": _of_requests,
}
"""By place of the checks."""
