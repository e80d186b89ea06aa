"""Writes the golden vectors: wire bytes with what they mean, for firmware authors and for the tests.

::

    python -m firmware_protocol.golden

In this order: how wire frames and packets are written, damage that a receiver must drop, count and
survive, the examples (at least one wire frame of every kind), every verb and setting, signed wire
frames, and the files. The tests compare against the committed files, so a change of the wire cannot
pass unnoticed.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from hashlib import blake2s
from pathlib import Path
from typing import Any

from firmware_protocol.can_framing import (
    MAX_CAN_BODY_SIZE,
    MAX_CLASSIC_BODY_SIZE,
    CanFrame,
    CanFrameDecoder,
    fragment,
    pack_can_records,
)
from firmware_protocol.can_transfer import FlowControl, FlowStatus, PieceType, flow_control_piece
from firmware_protocol.commands import (
    FACTORY_RESET_MAGIC,
    VERBS,
    Result,
    Verb,
    encode_arguments,
    encode_payload,
)
from firmware_protocol.device_settings import SETTINGS, decode_value, encode_value
from firmware_protocol.fields import WireField
from firmware_protocol.flash_slots import encode_slot
from firmware_protocol.framing import (
    BROADCAST,
    DELIMITER,
    MAX_FRAME_SIZE,
    PROTOCOL_VERSION,
    FrameDecoder,
    WireFrame,
    encode_frame,
)
from firmware_protocol.kinds import Kind
from firmware_protocol.packets import (
    Acknowledgement,
    Command,
    DeviceInfo,
    Event,
    FusedSample,
    Health,
    InertialSample,
    InertialSampleFine,
    LightSample,
    LocalMeasurement,
    LogLine,
    PacketDecoder,
    PassThrough,
    PressureSample,
    ReceivedPacket,
    SamplingTrigger,
    SyncRequest,
    SyncResponse,
    TransferToHost,
    TransferToModule,
    WireFrameDecoder,
    wire_frame,
)
from firmware_protocol.relay import relay_batch
from firmware_protocol.signing import HOST_SIGNER, KEY_SIZE, TAG_SIZE, WINDOW, SignedFrames


def frame_vector(frame: WireFrame) -> dict[str, Any]:
    """Return a wire frame on every link, and the packets it holds."""
    sent = encode_frame(frame)
    # A body that is too long for a bus has no form there, which is null in the file.
    classic = fragment(frame) if len(frame.body) <= MAX_CLASSIC_BODY_SIZE else None
    fd = fragment(frame, fd=True) if len(frame.body) <= MAX_CAN_BODY_SIZE else None
    return {
        "kind": frame.kind,
        "kind_name": Kind(frame.kind).name,
        "module": frame.module,
        "sequence": frame.sequence,
        "module_time_us": frame.module_time_us,
        "body": frame.body.hex(),
        "byte_stream": sent.hex(),
        "can_classic": classic and _can_vector(classic),
        "can_fd": fd and _can_vector(fd),
        "packets": [received_as_json(received) for received in PacketDecoder(FrameDecoder()).feed(sent)],
    }


def _can_vector(frames: Iterable[CanFrame]) -> dict[str, Any]:
    frames = list(frames)
    return {
        "frames": [{"identifier": f"0x{f.identifier:08x}", "data": f.data.hex()} for f in frames],
        "records": pack_can_records(frames).hex(),
    }


def received_as_json(received: ReceivedPacket) -> dict[str, Any]:
    """Return a received packet as JSON holds it: tuples as lists, bytes as hex."""
    values = dataclasses.asdict(received.packet)
    return {
        "kind": received.kind,
        "module": received.module,
        "sequence": received.sequence,
        "module_time_us": received.module_time_us,
        "type": type(received.packet).__name__,
        "values": {name: as_json(value) for name, value in values.items()},
    }


def as_json(value: Any) -> Any:
    """Return a value as JSON holds it: tuples as lists, bytes as hex."""
    if isinstance(value, bytes):
        return value.hex()
    return [as_json(element) for element in value] if isinstance(value, tuple) else value


_SAMPLE = InertialSample(specific_force=(0.0, 0.0, 9.81), angular_rate=(0.0, 0.1, 0.0))
GOOD = wire_frame(_SAMPLE, 3, 17, 1_250_000)
"""A module at rest, turning slowly about its y axis; its magnetometer was not read."""


def defect_vectors() -> dict[str, Any]:
    """Return what ``vectors/defects.json`` holds: damaged input, and what a receiver makes of it."""
    return {
        "protocol_version": PROTOCOL_VERSION,
        "byte_stream": [
            _damage_vector(name, damaged, FrameDecoder()) for name, damaged in _damaged_byte_streams().items()
        ],
        "can": [
            _damage_vector(name, pack_can_records(frames), CanFrameDecoder())
            for name, frames in _damaged_can_traffic().items()
        ],
    }


def _damaged_byte_streams() -> dict[str, bytes]:
    """Return damaged streams by name; each ends with a good wire frame, which is to come through."""
    sent = encode_frame(GOOD)
    batch = relay_batch([GOOD, GOOD], 1, 1_250_100)
    damaged = {
        "an idle line": bytes(5),
        "one bit of the body turned": _with_bit_turned(sent, 14, 2),
        "noise longer than a wire frame": b"\xa5" * (MAX_FRAME_SIZE + 100) + b"\x00",
        "stuffing that points past its end": b"\x09abc\x00",
        "a few stray bytes": b"\x04abc\x00",
        "another version": encode_frame(dataclasses.replace(GOOD, version=2)),
        "unknown kind": encode_frame(dataclasses.replace(GOOD, kind=0x77)),
        "body a byte too long": encode_frame(dataclasses.replace(GOOD, body=GOOD.body + b"\x01")),
        "reserved bit of the mask set": encode_frame(
            dataclasses.replace(GOOD, body=_with_bit_turned(GOOD.body, 0, 3))
        ),
        "module 64": encode_frame(dataclasses.replace(GOOD, module=64)),
        "batch from a module": encode_frame(dataclasses.replace(batch, module=3)),
        "last entry of a batch cut short": encode_frame(dataclasses.replace(batch, body=batch.body[:-1])),
    }
    return {name: prefix + sent for name, prefix in damaged.items()}


def _damaged_can_traffic() -> dict[str, list[CanFrame]]:
    """Return damaged traffic by name; each ends with a good wire frame, which is to come through."""
    first, second, third = pieces = fragment(GOOD)
    short_identifier = CanFrame(0x123, b"\x01", is_extended=False)
    remote = dataclasses.replace(first, data=b"", is_remote=True)
    other_version = dataclasses.replace(first, identifier=first.identifier ^ 3 << 6)
    other_module = dataclasses.replace(second, identifier=second.identifier ^ 1 << 10)
    return {
        "second piece lost": [first, third, *pieces],
        "last piece lost": [first, second, *pieces],
        "second piece sent twice": [first, second, second, third, *pieces],
        "pieces out of order": [first, third, second, *pieces],
        "module of one piece changed": [first, other_module, third, *pieces],
        "one bit of a piece turned": [
            first,
            dataclasses.replace(second, data=_with_bit_turned(second.data, 2, 0)),
            third,
            *pieces,
        ],
        "traffic of others between": [first, short_identifier, second, remote, other_version, third],
    }


def _with_bit_turned(data: bytes, place: int, bit: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :]


def _damage_vector(name: str, damaged: bytes, frames: WireFrameDecoder) -> dict[str, Any]:
    decoder = PacketDecoder(frames)
    packets = [received_as_json(received) for received in decoder.feed(damaged)]
    dropped = {defect.name: count for defect, count in decoder.dropped.items()}
    return {"name": name, "input": damaged.hex(), "dropped": dropped, "packets": packets}


UNIQUE_ID = bytes(range(12))
_ALL_SENSORS = InertialSample(
    specific_force=(-1.5, 3.25, 9.0), magnetic_field=(19.8, -3.1, -42.7), angular_rate=(0.5, -1.25, 12.0)
)
_BEYOND_RANGE = InertialSample(
    specific_force=(400.0, -400.0, 9.81), angular_rate=(0.0, 0.0, 40.0), triggered=True
)
_FINE = InertialSampleFine(
    specific_force=(0.01234, -0.5, 9.80665),
    magnetic_field=(19.8765, -3.1, -42.7),
    angular_rate=(1e-6, -2.5, 0.0),
)
_POSITION = LocalMeasurement(quantity=3, value=(1.25, -0.5, 0.75), sigma=(0.125, 0.125, 0.25))
_INFO = DeviceInfo(
    unique_id=UNIQUE_ID,
    hardware_version=(2, 1),
    firmware_version=(1, 4, 12),
    accelerometer_range=156.9,
    gyroscope_range=math.radians(2000),
    magnetometer_range=None,
    accelerometer_sampling_rate=100.0,
    gyroscope_sampling_rate=100.0,
    magnetometer_sampling_rate=None,
)
_HEALTH = Health(
    battery_percent=87,
    battery_voltage=3.912,
    temperature_celsius=-4.25,
    rssi_dbm=-61,
    uptime_s=86_400,
    samples_taken=8_640_000,
    samples_dropped=3,
    sensor_errors=0,
    resets=12,
)
_HEALTH_UNKNOWN = dataclasses.replace(
    _HEALTH, battery_percent=None, battery_voltage=None, temperature_celsius=None, rssi_dbm=None
)
_FUSED = FusedSample(orientation=(0.5, -0.5, 0.5, 0.5), displacement=(0.001234, -0.25, 1.5), interval=0.01)
_DARK = LightSample((0.0, 1.0, 0.25, 0.5, 0.75, 1 / 65535))
_PRESSURE = PressureSample((12.5, -3.75, 0.0), static_pressure=101_325.0, temperature_celsius=21.5)
_NMEA = b"$GNVTG,84.4,T,,M,1.2,N,2.2,K,A*1E\r\n"
_WRITE_RATE = Command(7, Verb.WRITE_SETTING, arguments=encode_arguments(Verb.WRITE_SETTING, 2, b"\xd0\x07"))
_ADDRESSED = Command(8, Verb.IDENTIFY, UNIQUE_ID, encode_arguments(Verb.IDENTIFY, 10))
_WRITTEN = Acknowledgement(
    7, Verb.WRITE_SETTING, Result.DONE, UNIQUE_ID, encode_payload(Verb.WRITE_SETTING, 2, b"\xd0\x07")
)
_LOCKED = Acknowledgement(9, Verb.FACTORY_RESET, Result.REFUSED, UNIQUE_ID)

_FRAMES: dict[str, WireFrame] = {
    "accelerometer and gyroscope": GOOD,
    "all three sensors": wire_frame(_ALL_SENSORS, 16, 65_535, 2**32 - 1),
    "beyond the range, clipped, on a trigger": wire_frame(_BEYOND_RANGE, 0, 0, 0),
    "no sensor read": wire_frame(InertialSample(), 63, 256, 65_536),
    "fine steps": wire_frame(_FINE, 5, 1000, 123_456_789),
    "position": wire_frame(_POSITION, 40, 2, 500_000),
    "module without magnetometer": wire_frame(_INFO, 7, 1, 100),
    "health": wire_frame(_HEALTH, 7, 9, 1_000_000),
    "health of a wired module": wire_frame(_HEALTH_UNKNOWN, 8, 9, 1_000_000),
    "health of the relay": wire_frame(_HEALTH, 254, 9, 1_000_000),
    "orientation fused on the module": wire_frame(_FUSED, 9, 4, 2_000_000),
    "photoelectric cells": wire_frame(_DARK, 10, 5, 2_000_100),
    "pressure tubes": wire_frame(_PRESSURE, 41, 6, 2_000_200),
    "pressure tubes without thermometer": wire_frame(
        dataclasses.replace(_PRESSURE, temperature_celsius=None), 41, 7, 2_000_300
    ),
    "a sentence of NMEA": wire_frame(PassThrough(1, _NMEA), 42, 8, 2_000_400),
    "two taps": wire_frame(Event(event=3, value=2), 9, 0, 2_000_500),
    "a line of the log": wire_frame(LogLine(level=2, text="température élevée"), 9, 1, 2_000_600),
    "an empty line of the log": wire_frame(LogLine(level=4, text=""), 9, 2, 2_000_700),
    "request for a module's clock": wire_frame(
        SyncRequest(token=513, host_time_us=1_795_000_000_123_456), 9, 3, 11
    ),
    "the module's clock": wire_frame(SyncResponse(513, 2**32 - 2, 150), 9, 3, 150),
    "trigger for all": wire_frame(SamplingTrigger(number=65_535), BROADCAST, 12, 13),
    "write a setting": wire_frame(_WRITE_RATE, 9, 14, 15),
    "to the device of one unique id": wire_frame(_ADDRESSED, BROADCAST, 15, 16),
    "a setting was written": wire_frame(_WRITTEN, 9, 16, 2_000_800),
    "refused": wire_frame(_LOCKED, 9, 17, 2_000_900),
    "first piece of 300 bytes": wire_frame(
        TransferToModule(PieceType.FIRST, 5, 300, bytes(range(1, 42))), 9, 18, 19
    ),
    "flow control: continue at piece 1, 8 of them, 1 ms apart": wire_frame(
        flow_control_piece(TransferToHost, 5, FlowControl(1, FlowStatus.CONTINUE, 8, 0.001)), 9, 19, 2_001_000
    ),
}
_SMALL_BATCH = relay_batch(list(_FRAMES.values())[:3], 77, 4_000_000)
_SUIT_BATCH = relay_batch([wire_frame(_ALL_SENSORS, m, 500, 5_000_000 + m) for m in range(17)], 78, 5_001_000)

FRAMES = _FRAMES | {"relay batch of three": _SMALL_BATCH, "relay batch of a suit": _SUIT_BATCH}
"""Every example by name."""


_CARD_FILES = ((1, 1_048_576, 250_000, 0xCBF43926), (2, 16, 2**32 - 1, 0))

_EXAMPLES: Mapping[Verb, tuple[tuple[Any, ...], tuple[Any, ...]]] = {
    Verb.HELLO: ((1, 2), (1, 1, 1)),
    Verb.IDENTIFY: ((10,), ()),
    Verb.GET_INFO: ((), ()),
    Verb.START: ((), ()),
    Verb.STOP: ((), ()),
    Verb.READ_SETTING: ((1,), (1, encode_value(1, 9))),
    Verb.WRITE_SETTING: ((2, encode_value(2, 200.0)), (2, encode_value(2, 200.0))),
    Verb.COMMIT: ((), (4_294_967_295,)),
    Verb.DISCARD: ((), ()),
    Verb.FACTORY_RESET: ((FACTORY_RESET_MAGIC,), ()),
    Verb.CARD_LIST: ((0,), (2, _CARD_FILES)),
    Verb.CARD_READ: ((1, 65_536, 5), (1, 65_536, b"bytes")),
    Verb.CARD_ERASE: ((0xFFFF,), ()),
}
"""Arguments and payload of each verb."""

OTHER_VALUES: Mapping[int, Any] = {
    1: 63,
    2: 4000.0,
    3: 313.8,
    4: 1.0,
    5: 1300.0,
    6: 99.5,
    7: 0.1,
    8: 3,
    9: tuple(place / 8 for place in range(-15, 15)),
    10: "poignet gauché",
}
"""A value of each setting that is not the factory's."""


def command_vectors() -> dict[str, Any]:
    """Return what ``vectors/commands.json`` holds."""
    vectors = [_verb_vector(verb, *example) for verb, example in _EXAMPLES.items()]
    return {"protocol_version": PROTOCOL_VERSION, "vectors": vectors}


def setting_vectors() -> dict[str, Any]:
    """Return what ``vectors/settings.json`` holds."""
    values = [(key, setting.factory) for key, setting in SETTINGS.items()] + list(OTHER_VALUES.items())
    # The largest there is: a reader that holds it in a signed number fails.
    generation = 2**32 - 1
    return {
        "protocol_version": PROTOCOL_VERSION,
        "vectors": [_setting_vector(key, value) for key, value in values],
        "slot": {
            "generation": generation,
            "settings": [_setting_vector(key, value) for key, value in OTHER_VALUES.items()],
            "image": encode_slot(generation, OTHER_VALUES).hex(),
        },
    }


def _verb_vector(verb: Verb, arguments: tuple[Any, ...], payload: tuple[Any, ...]) -> dict[str, Any]:
    sent, answered = encode_arguments(verb, *arguments), encode_payload(verb, *payload)
    command = Command(transaction=100 + verb, verb=verb, arguments=sent)
    answer = Acknowledgement(command.transaction, verb, Result.DONE, UNIQUE_ID, answered)
    declared = VERBS[verb]
    return {
        "verb": int(verb),
        "name": declared.name,
        "arguments": {"values": _named(declared.arguments, arguments), "bytes": sent.hex()},
        "payload": {"values": _named(declared.payload, payload), "bytes": answered.hex()},
        "command": frame_vector(wire_frame(command, 9, int(verb), 1_000)),
        "acknowledgement": frame_vector(wire_frame(answer, 9, int(verb), 2_000)),
    }


def _named(declared: tuple[WireField, ...], values: tuple[Any, ...]) -> dict[str, Any]:
    names = [field.name for field in declared] + ["entries"]
    return {name: as_json(value) for name, value in zip(names, values, strict=False)}


def _setting_vector(key: int, value: Any) -> dict[str, Any]:
    data = encode_value(key, value)
    return {
        "key": key,
        "name": SETTINGS[key].name,
        "value": as_json(decode_value(key, data)),
        "bytes": data.hex(),
    }


KEY = bytes(range(KEY_SIZE))
_MODULE = 0x1234ABCD
_COUNT = 0x0102030405
"""Each vector's receiver takes nothing up to this count."""
_HASHED = (0, 1, 55, 63, 64, 65, 127, 128, 129, 1000)
"""Lengths about the ends of the hash's blocks, bytes."""


def signing_vectors() -> dict[str, Any]:
    """Return what ``vectors/signing.json`` holds."""
    return {
        "protocol_version": PROTOCOL_VERSION,
        "key": KEY.hex(),
        "blake2s": [_hash_vector(bytes(n % 251 for n in range(size))) for size in _HASHED],
        "from_module": [
            _signed_vector(name, sent, SignedFrames(KEY, count=_COUNT))
            for name, sent in _from_module().items()
        ],
        "from_host": [
            _signed_vector(name, sent, SignedFrames(KEY, _MODULE, _COUNT))
            for name, sent in _from_host().items()
        ],
    }


def _from_module() -> dict[str, bytes]:
    """Return what the host is to take, or to refuse."""
    sent = encode_frame(GOOD)
    first, second, third = (_signed(sent, count) for count in range(1, 4))
    return {
        "a sample": first,
        "the largest count": _signed(sent, 2**48 - 1 - _COUNT),
        "two of one count": third + third,
        "the older one last": third + first,
        "older than the receiver's start": _signed(sent, 0),
        "without a signature": sent + first,
        "a signature without a wire frame": second[: -len(sent)] + first,
        "another key": SignedFrames(bytes(KEY_SIZE), _MODULE, _COUNT).sign(sent) + first,
        "one bit turned": first[:-5] + bytes([first[-5] ^ 2]) + first[-4:],
        "signed by the receiver": SignedFrames(KEY, HOST_SIGNER, _COUNT).sign(sent) + first,
    }


def _from_host() -> dict[str, bytes]:
    """Return what a module is to take, or to refuse."""
    host = SignedFrames(KEY, HOST_SIGNER, _COUNT)
    asked = encode_frame(wire_frame(SyncRequest(7, 1_700_000_000_000_000), 255, 0, 0))
    first, second = host.sign(asked), host.sign(asked)
    far = SignedFrames(KEY, HOST_SIGNER, _COUNT + WINDOW).sign(asked)
    return {
        "a time request": first,
        "the count alone": host.sign(DELIMITER),
        "a request sent twice": first + first,
        "the older one last": second + first,
        "behind the window": far + first,
        "a request without a signature": asked + first,
        "signed by a module": _signed(asked, 1) + second,
    }


def _signed(frame: bytes, ahead: int) -> bytes:
    """Return a frame signed by the module, ``ahead`` counts above what the receiver begins at."""
    return SignedFrames(KEY, _MODULE, _COUNT + ahead - 1).sign(frame)


def _hash_vector(data: bytes) -> dict[str, str]:
    return {"data": data.hex(), "tag": blake2s(data, key=KEY, digest_size=TAG_SIZE).hexdigest()}


def _signed_vector(name: str, sent: bytes, end: SignedFrames) -> dict[str, Any]:
    opened = end.feed(sent)
    dropped = {defect.name: count for defect, count in end.dropped.items()}
    return {
        "name": name,
        "signer": end.signer,
        "count": _COUNT,
        "input": sent.hex(),
        "opened": opened.hex(),
        "dropped": dropped,
        "count_after": end.count,
        "owes_count": end.owes_count,
    }


VECTORS = Path(__file__).parent / "vectors"

FILES = ("packets", "defects", "commands", "settings", "signing")


def packet_vectors() -> dict[str, Any]:
    """Return what ``vectors/packets.json`` holds."""
    vectors = [{"name": name, **frame_vector(frame)} for name, frame in FRAMES.items()]
    return {"protocol_version": PROTOCOL_VERSION, "vectors": vectors}


def write(folder: Path) -> None:
    """Write every file of vectors into a folder."""
    contents = (packet_vectors(), defect_vectors(), command_vectors(), setting_vectors(), signing_vectors())
    for name, content in zip(FILES, contents, strict=True):
        text = json.dumps(content, indent=1, ensure_ascii=False)
        (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(VECTORS)
