"""DBC files: as generated, and decoded by cantools to the values that our own decoder gives."""

from __future__ import annotations

import struct
from random import Random
from typing import Any

import pytest

from firmware_protocol import (
    BROADCAST,
    FROM_HOST,
    PACKETS,
    CanFrame,
    Defect,
    InertialSample,
    InertialSampleFine,
    Kind,
    Packet,
    WireFrame,
    decode_body,
    fragment,
)
from firmware_protocol.dbc import ALL_SENSORS, PATH, render
from firmware_protocol.fields import layout_of
from firmware_protocol.framing import serialize
from firmware_protocol.golden import FRAMES

cantools = pytest.importorskip("cantools", reason="cantools is not installed")

FIXED = [kind for kind in PACKETS if layout_of(PACKETS[kind]).rest is None]
OPEN_ENDED = [kind for kind in PACKETS if layout_of(PACKETS[kind]).rest is not None]


@pytest.fixture(scope="module")
def database() -> Any:
    return load(render(range(17)))


def load(text: str) -> Any:
    return cantools.database.load_string(text, "dbc")


def test_the_committed_file_is_what_would_be_generated():
    assert PATH.read_text(encoding="ascii") == render([0]), "run: python -m firmware_protocol.dbc"


def decoded(database: Any, piece: CanFrame) -> dict[str, Any]:
    """What cantools makes of one CAN frame of ours."""
    message = database.get_message_by_frame_id(piece.identifier)
    assert message.is_extended_frame
    assert message.is_fd == piece.is_fd
    values: dict[str, Any] = message.decode(piece.data, decode_choices=False, allow_truncated=True)
    return values


def joined(database: Any, pieces: list[CanFrame]) -> dict[str, Any]:
    """The values of all pieces; numbers that were cut are put together as ``README.md`` says."""
    values: dict[str, Any] = {}
    for piece in pieces:
        values |= decoded(database, piece)
    for low in [name for name in values if name.endswith("_low")]:
        name = low.removesuffix("_low")
        if f"{name}_high" in values:
            values[name] = (values.pop(low), values.pop(f"{name}_high"))
    return values


def value_of(values: dict[str, Any], name: str, width_of_low: int | None, is_float: bool) -> float:
    """A signal's value, wherever the masks have put it."""
    (found,) = (v for key, v in values.items() if key == name or key.startswith(f"{name}_at_"))
    if not isinstance(found, tuple):
        return float(found)
    if not is_float:
        return float(found[0] + found[1])
    assert width_of_low is not None
    bits = int(found[0]) | int(found[1]) << width_of_low
    return float(struct.unpack("<f", struct.pack("<I", bits))[0])


def assert_equal(values: dict[str, Any], frame: WireFrame, packet: Packet) -> None:
    """Compares header, fields, flags and checksum with what was sent."""
    assert (values["sequence"], values["module_time_us"]) == (frame.sequence, frame.module_time_us)
    assert values["body_length"] == len(frame.body)
    layout = layout_of(type(packet))
    at = 7 + layout.has_mask
    for declared in layout.fields:
        value = getattr(packet, declared.name)
        if declared.is_rest or (value is None and declared.presence_bit is not None):
            continue
        width = struct.calcsize("<" + declared.code)
        if value is None:
            raw = values[declared.name]
            total = sum(raw) if isinstance(raw, tuple) else raw
            assert round(total / (declared.scale or 1)) == declared.absent
            at += width
            continue
        elements = value if isinstance(value, tuple | bytes) else (value,)
        vector = declared.scale is not None or declared.code == "f"
        endings = {3: "xyz", 4: "wxyz"}.get(declared.count, range(99)) if vector else range(99)
        for element, ending in zip(elements, endings, strict=False):
            name = declared.name if declared.count == 1 else f"{declared.name}_{ending}"
            in_low = 8 * (8 - at % 8)
            assert value_of(values, name, in_low, declared.code == "f") == pytest.approx(
                element, rel=1e-12, abs=1e-12
            )
            at += width
    for declared_flag in layout.flags:
        assert values[declared_flag.name] == getattr(packet, declared_flag.name)
    if layout.rest is None:
        assert value_of(values, "crc32", None, False) == int.from_bytes(serialize(frame)[-4:], "little")


def random_frame(rng: Random, kind: int, mask: int, module: int) -> tuple[WireFrame, Packet]:
    """A wire frame with a good body: bytes are drawn until they are one."""
    layout = layout_of(PACKETS[kind])
    while True:
        least, most = layout.sizes(mask)
        data = bytearray(rng.randbytes(rng.randint(least, most)))
        if layout.has_mask:
            data[0] = mask
        elif layout.fields[0].meanings:
            data[0] = rng.choice(list(layout.fields[0].meanings))
        if kind == Kind.ACKNOWLEDGEMENT:
            data[3] = rng.randrange(10)
        if kind == Kind.HEALTH:
            data[0] %= 101
        if kind == Kind.LOG_LINE:
            data[1:] = bytes(byte % 96 + 32 for byte in data[1:])
        if kind == Kind.LOCAL_MEASUREMENT:
            data[13:] = struct.pack("<3f", *(rng.uniform(0, 9) for _ in range(3)))
        packet = decode_body(kind, bytes(data))
        if not isinstance(packet, Defect):
            return WireFrame(kind, module, rng.randrange(65536), rng.randrange(2**32), bytes(data)), packet


def modules_of(kind: int) -> tuple[int, ...]:
    return (0, 16, BROADCAST) if kind in FROM_HOST else (0, 16)


@pytest.mark.parametrize("kind", FIXED)
def test_fd_frames_decode_to_our_values_with_every_mask(database: Any, kind: int):
    rng = Random(kind)
    for mask in layout_of(PACKETS[kind]).valid_masks():
        for module in modules_of(kind):
            frame, packet = random_frame(rng, kind, mask, module)
            (piece,) = fragment(frame, fd=True)
            assert_equal(decoded(database, piece), frame, packet)


@pytest.mark.parametrize("kind", FIXED)
def test_classic_frames_decode_to_our_values_with_all_sensors(database: Any, kind: int):
    rng = Random(kind)
    masks = [m for m in layout_of(PACKETS[kind]).valid_masks() if m & 7 == 7] or [0]
    for mask in masks * 3:
        for module in modules_of(kind):
            frame, packet = random_frame(rng, kind, mask, module)
            assert_equal(joined(database, fragment(frame)), frame, packet)


@pytest.mark.parametrize("sensors", [ALL_SENSORS[:1], ALL_SENSORS[::2], ALL_SENSORS[1:]])
@pytest.mark.parametrize("kind", [InertialSample.KIND, InertialSampleFine.KIND])
def test_classic_frames_decode_with_the_sensors_that_the_file_was_made_for(
    kind: int, sensors: tuple[str, ...]
):
    database, rng = load(render(modules=(5,), sensors=sensors)), Random(1)
    mask = sum(1 << place for place, sensor in enumerate(ALL_SENSORS) if sensor in sensors)
    frame, packet = random_frame(rng, kind, mask, 5)
    assert_equal(joined(database, fragment(frame)), frame, packet)


@pytest.mark.parametrize("kind", OPEN_ENDED)
def test_of_bodies_without_a_fixed_size_the_fixed_part_decodes(database: Any, kind: int):
    rng = Random(kind)
    layout = layout_of(PACKETS[kind])
    known = {message.frame_id for message in database.messages}
    for _ in range(20):
        frame, packet = random_frame(rng, kind, 0, 7)
        pieces = [piece for piece in fragment(frame) if piece.identifier in known]
        values = joined(database, pieces)
        assert (values["sequence"], values["body_length"]) == (frame.sequence, len(frame.body))
        first = layout.fields[0]
        sent = getattr(packet, first.name)
        assert value_of(values, first.name, None, False) == sent


def test_the_golden_samples_decode_by_hand(database: Any):
    """All sensors, module 16: -1.5 m/s² is -313 steps of 16 g / 2^15."""
    frame = FRAMES["all three sensors"]
    values = decoded(database, fragment(frame, fd=True)[0])
    assert values["specific_force_x"] == pytest.approx(-313 * 16 * 9.80665 / 32768, rel=1e-12)
    assert values["magnetic_field_z"] == pytest.approx(-42.7, abs=1e-12)
    assert values["sensors"] == 7
    first, *_ = fragment(frame)
    assert decoded(database, first) == {
        "sequence": 65535,
        "module_time_us": 2**32 - 1,
        "body_length": 19,
        "sensors": 7,
        "specific_force_clipped": 0,
        "magnetic_field_clipped": 0,
        "angular_rate_clipped": 0,
        "triggered": 0,
    }


def test_names_are_no_longer_than_tools_allow_and_no_two_messages_share_an_identifier(database: Any):
    identifiers = [message.frame_id for message in database.messages]
    assert len(set(identifiers)) == len(identifiers)
    for message in database.messages:
        assert len(message.name) <= 32
        assert all(len(signal.name) <= 32 for signal in message.signals)
        assert len({signal.name for signal in message.signals}) == len(message.signals)


def test_every_kind_is_there_for_every_module(database: Any):
    names = {message.name.rpartition("_")[0] for message in database.messages}
    expected = {f"{cls.__name__}_{m}" for cls in PACKETS.values() for m in range(17)}
    expected |= {f"{PACKETS[kind].__name__}_{BROADCAST}" for kind in FROM_HOST}
    assert names == expected


def test_a_file_may_be_made_for_other_modules():
    database = load(render(modules=(63,)))
    assert {message.senders[0] for message in database.messages} == {"Host", "Module_63"}
