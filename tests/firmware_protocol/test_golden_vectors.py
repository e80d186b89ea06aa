"""The committed golden vectors: the encoder, the decoder and the spec by hand must all agree with them."""

from __future__ import annotations

import json
import struct
from typing import Any
from zlib import crc32

import pytest

from firmware_protocol import (
    SETTINGS,
    VERBS,
    CanFrameDecoder,
    FrameDecoder,
    Kind,
    PacketDecoder,
    WireFrame,
    decode_arguments,
    decode_payload,
    decode_value,
    encode_arguments,
    encode_frame,
    encode_packet,
    encode_payload,
    encode_value,
    fragment,
    pack_can_records,
)
from firmware_protocol.flash_slots import decode_slot
from firmware_protocol.golden import (
    VECTORS,
    as_json,
    command_vectors,
    defect_vectors,
    packet_vectors,
    received_as_json,
    setting_vectors,
)

PACKETS = json.loads((VECTORS / "packets.json").read_text(encoding="utf-8"))
COMMANDS = json.loads((VECTORS / "commands.json").read_text(encoding="utf-8"))
SETTING_VECTORS = json.loads((VECTORS / "settings.json").read_text(encoding="utf-8"))
DEFECTS = json.loads((VECTORS / "defects.json").read_text(encoding="utf-8"))

FRAME_VECTORS = PACKETS["vectors"] + [
    {"name": f"{end} {vector['name']}", **vector[end]}
    for vector in COMMANDS["vectors"]
    for end in ("command", "acknowledgement")
]

every_packet_vector = pytest.mark.parametrize("vector", FRAME_VECTORS, ids=lambda v: v["name"])
every_verb_vector = pytest.mark.parametrize("vector", COMMANDS["vectors"], ids=lambda v: v["name"])


def unstuff_by_hand(stuffed: bytes) -> bytes:
    out = bytearray()
    while stuffed:
        code = stuffed[0]
        out += stuffed[1:code]
        stuffed = stuffed[code:]
        if code < 255 and stuffed:
            out.append(0)
    return bytes(out)


def frame_of(vector: dict[str, Any]) -> WireFrame:
    header = (vector[name] for name in ("kind", "module", "sequence", "module_time_us"))
    return WireFrame(*header, bytes.fromhex(vector["body"]))


def test_the_first_vector_is_as_worked_out_by_hand():
    """Mask 5; on the z axis 9.81 / (16 g / 2^15) = 2048.7; about y 0.1 / (2000 deg/s / 2^15) = 93.9."""
    vector = PACKETS["vectors"][0]
    body = "05" + "0000 0000 0108".replace(" ", "") + "0000 5e00 0000".replace(" ", "")
    assert vector["body"] == body
    content = bytes.fromhex("01 10 03 1100 d0121300" + body)
    checksum = crc32(content)
    assert checksum == 0x92576D85
    assert vector["byte_stream"] == (
        "05 0110031104 d0121302 0501010103 01080102 5e010105 856d579200"
    ).replace(" ", "")
    (received,) = vector["packets"]
    assert received["values"]["specific_force"] == pytest.approx(
        [0, 0, 2049 * 16 * 9.80665 / 32768], rel=1e-14
    )


@every_packet_vector
def test_the_byte_stream_is_the_spec_taken_by_hand(vector: dict[str, Any]):
    sent = bytes.fromhex(vector["byte_stream"])
    assert sent.count(0) == 1
    assert sent[-1] == 0
    raw = unstuff_by_hand(sent[:-1])
    header = struct.unpack_from("<BBBHI", raw)
    assert header == (1, vector["kind"], vector["module"], vector["sequence"], vector["module_time_us"])
    assert raw[9:-4].hex() == vector["body"]
    assert int.from_bytes(raw[-4:], "little") == crc32(raw[:-4])


@every_packet_vector
@pytest.mark.parametrize("link", ["can_classic", "can_fd"])
def test_the_can_frames_are_the_spec_taken_by_hand(vector: dict[str, Any], link: str):
    if vector[link] is None:
        assert len(vector["body"]) // 2 > (245 if link == "can_classic" else 255)
        return
    pieces = vector[link]["frames"]
    for index, piece in enumerate(pieces):
        identifier = int(piece["identifier"], 16)
        assert identifier >> 18 & 0xFF == vector["kind"]
        assert identifier >> 10 & 0xFF == vector["module"]
        assert identifier >> 6 & 0xF == 1
        assert bool(identifier >> 5 & 1) == (index == len(pieces) - 1)
        assert identifier & 0x1F == index
    payload = bytes.fromhex("".join(piece["data"] for piece in pieces))
    raw = unstuff_by_hand(bytes.fromhex(vector["byte_stream"])[:-1])
    size = len(raw) - 13
    assert payload[: 11 + size] == raw[3:9] + bytes([size]) + raw[9:]
    assert not any(payload[11 + size :])


@every_packet_vector
def test_encoding_gives_the_committed_bytes(vector: dict[str, Any]):
    frame = frame_of(vector)
    assert encode_frame(frame).hex() == vector["byte_stream"]
    for fd, link in ((False, "can_classic"), (True, "can_fd")):
        if vector[link] is not None:
            assert pack_can_records(fragment(frame, fd)).hex() == vector[link]["records"]


@every_packet_vector
def test_decoding_gives_the_committed_values_on_every_link(vector: dict[str, Any]):
    inputs = [(FrameDecoder(), vector["byte_stream"])]
    inputs += [(CanFrameDecoder(), vector[k]["records"]) for k in ("can_classic", "can_fd") if vector[k]]
    for frames, data in inputs:
        decoder = PacketDecoder(frames)
        received = decoder.feed(bytes.fromhex(data))
        assert [received_as_json(packet) for packet in received] == vector["packets"]
        assert not decoder.dropped
        if vector["kind"] != Kind.RELAY_BATCH:
            assert encode_packet(received[0].packet).hex() == vector["body"]


def test_a_command_is_as_worked_out_by_hand():
    """Transaction 111, verb 11, nobody's unique id; setting 2 (sampling rate) = 2000 tenths of a hertz."""
    vector = next(v for v in COMMANDS["vectors"] if v["name"] == "WRITE_SETTING")
    body = "6f00" + "0b" + "00" * 12 + "02" + "d007"
    assert vector["command"]["body"] == body
    content = bytes.fromhex("01 50 09 0b00 e8030000" + body)
    checksum = crc32(content).to_bytes(4, "little")
    assert checksum.hex() == "f9743b81"
    pieces = vector["command"]["can_classic"]["frames"]
    payload = content[3:9] + bytes([18]) + content[9:] + checksum
    # Priority 1, kind 0x50, module 9, version 1, last, index.
    base = 1 << 26 | 0x50 << 18 | 9 << 10 | 1 << 6
    assert [(int(p["identifier"], 16), p["data"]) for p in pieces] == [
        (base, payload[:8].hex()),
        (base | 1, payload[8:16].hex()),
        (base | 2, payload[16:24].hex()),
        (base | 1 << 5 | 3, payload[24:].hex()),
    ]
    (received,) = vector["command"]["packets"]
    assert received["values"] == {
        "transaction": 111,
        "verb": 11,
        "unique_id": "00" * 12,
        "arguments": "02d007",
    }


@every_verb_vector
def test_arguments_and_payloads_are_as_committed(vector: dict[str, Any]):
    for end, encode, decode in (
        ("arguments", encode_arguments, decode_arguments),
        ("payload", encode_payload, decode_payload),
    ):
        data = bytes.fromhex(vector[end]["bytes"])
        values = decode(vector["verb"], data)
        assert values is not None
        assert [as_json(value) for value in values] == list(vector[end]["values"].values())
        assert encode(vector["verb"], *values) == data
    sent, answered = (vector[end]["packets"][0]["values"] for end in ("command", "acknowledgement"))
    assert sent["arguments"] == vector["arguments"]["bytes"]
    assert answered["payload"] == vector["payload"]["bytes"]


def test_settings_are_as_committed():
    for vector in SETTING_VECTORS["vectors"]:
        value = decode_value(vector["key"], bytes.fromhex(vector["bytes"]))
        assert as_json(value) == vector["value"]
        assert encode_value(vector["key"], value).hex() == vector["bytes"]
        assert SETTINGS[vector["key"]].name == vector["name"]


def test_the_committed_slot_is_the_spec_taken_by_hand():
    slot = SETTING_VECTORS["slot"]
    image = bytes.fromhex(slot["image"])
    entries = b"".join(
        bytes([s["key"], len(s["bytes"]) // 2]) + bytes.fromhex(s["bytes"]) for s in slot["settings"]
    )
    content = struct.pack("<IIHH", 0x4D475331, slot["generation"], len(entries), 0) + entries
    assert image == content + struct.pack("<I", crc32(content))
    found = decode_slot(image)
    assert found is not None
    assert found.generation == slot["generation"] == 2**32 - 1
    assert {key: value.hex() for key, value in found.settings.items()} == {
        s["key"]: s["bytes"] for s in slot["settings"]
    }


EXPECTED_DROPS = {
    "an idle line": {},
    "one bit of the body turned": {"BAD_CRC": 1},
    "noise longer than a wire frame": {"OVERLONG": 1},
    "stuffing that points past its end": {"BAD_STUFFING": 1},
    "a few stray bytes": {"TOO_SHORT": 1},
    "another version": {"BAD_VERSION": 1},
    "unknown kind": {"UNKNOWN_KIND": 1},
    "body a byte too long": {"BAD_LENGTH": 1},
    "reserved bit of the mask set": {"BAD_VALUE": 1},
    "module 64": {"BAD_MODULE": 1},
    "batch from a module": {"BAD_MODULE": 1},
    "last entry of a batch cut short": {"TRUNCATED": 1},
    "second piece lost": {"LOST_FRAGMENT": 1},
    "last piece lost": {"LOST_FRAGMENT": 1},
    "second piece sent twice": {"LOST_FRAGMENT": 1},
    "pieces out of order": {"LOST_FRAGMENT": 2},
    "module of one piece changed": {"LOST_FRAGMENT": 2},
    "one bit of a piece turned": {"BAD_CRC": 1},
    "traffic of others between": {"FOREIGN": 3},
}


@pytest.mark.parametrize("link", ["byte_stream", "can"])
def test_damage_is_counted_as_committed_and_the_good_packet_survives(link: str):
    good = PACKETS["vectors"][0]["packets"][0]
    for vector in DEFECTS[link]:
        decoder = PacketDecoder(FrameDecoder() if link == "byte_stream" else CanFrameDecoder())
        received = [received_as_json(packet) for packet in decoder.feed(bytes.fromhex(vector["input"]))]
        dropped = {defect.name: count for defect, count in decoder.dropped.items()}
        assert dropped == vector["dropped"] == EXPECTED_DROPS[vector["name"]], vector["name"]
        assert received == vector["packets"]
        assert received[-1] == good


def test_every_kind_and_every_expected_drop_has_a_vector():
    assert {vector["kind"] for vector in PACKETS["vectors"]} == set(Kind)
    assert [vector["verb"] for vector in COMMANDS["vectors"]] == list(VERBS)
    assert [vector["key"] for vector in SETTING_VECTORS["vectors"]] == [*SETTINGS, *SETTINGS]
    assert {vector["name"] for link in ("byte_stream", "can") for vector in DEFECTS[link]} == set(
        EXPECTED_DROPS
    )


def test_the_committed_files_are_what_would_be_written():
    assert packet_vectors() == PACKETS
    assert command_vectors() == COMMANDS
    assert setting_vectors() == SETTING_VECTORS
    assert defect_vectors() == DEFECTS
