"""The C header and the Python package on the same bytes: golden vectors, random packets, damaged streams."""

from __future__ import annotations

import json
import random
import struct
import subprocess
from collections import Counter
from typing import Any

import pytest

from firmware_protocol import (
    CanFrameDecoder,
    Defect,
    FrameDecoder,
    PacketDecoder,
    WireFrame,
    decode_body,
    encode_frame,
    fragment,
    pack_can_records,
    relay_batch,
    unpack_can_records,
)
from firmware_protocol.can_framing import MAX_CAN_BODY_SIZE, MAX_CLASSIC_BODY_SIZE, CanFrame
from firmware_protocol.fields import INTEGER_RANGE, WireField, layout_of
from firmware_protocol.golden import VECTORS
from firmware_protocol.packets import PACKETS
from firmware_protocol.relay import RELAY_BATCH, split_batch

DEFECTS = list(Defect)


def vectors(name: str) -> Any:
    return json.loads((VECTORS / f"{name}.json").read_text(encoding="utf-8"))


def wire_frames_of(content: Any) -> list[dict[str, Any]]:
    """Every wire frame in a file of vectors, wherever it stands."""
    if isinstance(content, list):
        return [found for part in content for found in wire_frames_of(part)]
    if not isinstance(content, dict):
        return []
    here = [content] if "byte_stream" in content and "body" in content else []
    return here + [found for part in content.values() for found in wire_frames_of(part)]


GOLDEN_FRAMES = wire_frames_of(
    [vectors(path.stem) for path in sorted(VECTORS.glob("*.json")) if path.stem != "defects"]
)


def expected_lines(what: str, data: bytes) -> list[str]:
    """What the driver is to say, from the Python decoders."""
    lines = []
    frames = FrameDecoder() if what == "s" else CanFrameDecoder()
    for frame in frames.feed(data):
        lines.append(f"frame {encode_frame(frame).hex()}")
        for name, fd, limit in (("classic", False, MAX_CLASSIC_BODY_SIZE), ("fd", True, MAX_CAN_BODY_SIZE)):
            if len(frame.body) <= limit:
                lines.append(f"{name} {pack_can_records(fragment(frame, fd)).hex()}")
        if frame.kind != RELAY_BATCH:
            lines += packet_lines(frame.kind, frame.module, frame.sequence, frame.module_time_us, frame.body)
        elif frame.module == 254:
            entries, _ = split_batch(frame.body)
            lines += [line for entry in entries for line in packet_lines(*entry)]
            again = [WireFrame(*entry) for entry in entries if entry[0] != RELAY_BATCH]
            lines.append(f"batch {relay_batch(again, 0, 0).body.hex()}")
    decoder = PacketDecoder(FrameDecoder() if what == "s" else CanFrameDecoder())
    received = decoder.feed(data)
    assert len(received) == sum(line.startswith("packet") for line in lines)
    dropped = sorted((DEFECTS.index(defect) + 1, count) for defect, count in decoder.dropped.items())
    lines += [f"dropped {number} {count}" for number, count in dropped]
    return [*lines, f"accepted {frames.accepted}"]


def packet_lines(kind: int, module: int, sequence: int, module_time_us: int, body: bytes) -> list[str]:
    allowed = set(range(64)) | {254} | ({255} if kind in (0x40, 0x42, 0x50, 0x5E) else set())
    if module not in allowed or type(decode_body(kind, body)) is Defect:
        return []
    return [f"packet {kind} {module} {sequence} {module_time_us} {body.hex()}"]


def agree(answers, cases: list[tuple[str, bytes]]) -> list[list[str]]:
    """Asserts that both sides make the same of every case; returns what they made."""
    expected = [expected_lines(what, data) for what, data in cases]
    for case, said, wanted in zip(cases, answers(cases), expected, strict=True):
        assert said == wanted, f"{case[0]} {case[1].hex()}"
    return expected


def drops(said: list[list[str]]) -> Counter[Defect]:
    lines = (line.split() for answer in said for line in answer if line.startswith("dropped"))
    return sum((Counter({DEFECTS[int(number) - 1]: int(count)}) for _, number, count in lines), Counter())


def test_every_golden_wire_frame_is_encoded_and_decoded_byte_for_byte(answers):
    cases, wanted = [], []
    for vector in GOLDEN_FRAMES:
        for what, data in (
            ("s", vector["byte_stream"]),
            *(("c", vector[link]["records"]) for link in ("can_classic", "can_fd") if vector[link]),
        ):
            cases.append((what, bytes.fromhex(data)))
            wanted.append(vector)
    assert len(cases) > 80
    for said, vector in zip(agree(answers, cases), wanted, strict=True):
        assert said[0] == f"frame {vector['byte_stream']}"
        for link, name in (("can_classic", "classic"), ("can_fd", "fd")):
            records = [line.split()[1] for line in said if line.startswith(f"{name} ")]
            assert records == ([vector[link]["records"]] if vector[link] else [])
        packets = [line.split()[1:4] for line in said if line.startswith("packet")]
        assert packets == [[str(p[k]) for k in ("kind", "module", "sequence")] for p in vector["packets"]]
        if vector["kind"] != RELAY_BATCH:
            assert said[3].split()[-1] == vector["body"]
        else:
            assert f"batch {vector['body']}" in said


@pytest.mark.parametrize(("link", "what"), [("byte_stream", "s"), ("can", "c")])
def test_every_golden_defect_is_dropped_for_the_same_reason(answers, link: str, what: str):
    golden = vectors("defects")[link]
    said = agree(answers, [(what, bytes.fromhex(vector["input"])) for vector in golden])
    for vector, answer in zip(golden, said, strict=True):
        counted = {defect.name: count for defect, count in drops([answer]).items()}
        assert counted == vector["dropped"], vector["name"]


def random_element(rng: random.Random, declared: WireField, in_range: bool) -> Any:
    if declared.code == "f":
        bits = rng.choice((0, 0x80000000, 0x7F7FFFFF, rng.getrandbits(31), rng.getrandbits(32)))
        return struct.unpack("<f", struct.pack("<I", bits))[0]
    if declared.meanings and in_range:
        return rng.choice(list(declared.meanings))
    low, high = INTEGER_RANGE[declared.code]
    return rng.choice((low, high, 0, rng.randint(low, high), rng.randint(max(low, -100), 120)))


def random_text(rng: random.Random, size: int) -> bytes:
    letters = ("a", "é", "µ", "\u0800", "漢", "\ud7ff", "\ue000", "\U00010000", "\U0010ffff")
    return "".join(rng.choice(letters) for _ in range(size // 4)).encode()


def random_bytes(rng: random.Random, declared: WireField) -> bytes:
    size = declared.count
    if declared.is_rest:
        size = rng.choice((declared.min_size, declared.max_size, rng.randint(0, declared.max_size + 1)))
    if not declared.is_text or rng.random() < 0.2:
        return rng.randbytes(size)
    return random_text(rng, size).ljust(0 if declared.is_rest else size, b"\x00")


def random_body(rng: random.Random, kind: int) -> bytes:
    """A body that is good more often than not, with values at and beyond every limit."""
    layout = layout_of(PACKETS[kind])
    is_good = rng.random() < 0.8
    mask = rng.choice(layout.valid_masks()) if is_good else rng.getrandbits(8)
    body = bytes([mask]) if layout.has_mask else b""
    for declared in layout.present(mask):
        if declared.code == "s":
            body += random_bytes(rng, declared)
        else:
            elements = [random_element(rng, declared, is_good) for _ in range(declared.count)]
            body += struct.pack(f"<{declared.count}{declared.code}", *elements)
    if rng.random() < 0.05:
        body = body[:-1] if rng.random() < 0.5 else body + b"\x00"
    return body


def random_frame(rng: random.Random) -> WireFrame:
    kind = rng.choice([*PACKETS, rng.getrandbits(8)])
    body = random_body(rng, kind) if kind in PACKETS else rng.randbytes(rng.randint(0, 300))
    module = rng.choice((rng.randint(0, 63), rng.randint(0, 63), 254, 255, 64))
    return WireFrame(kind, module, rng.getrandbits(16), rng.getrandbits(32), body)


def random_batch(rng: random.Random) -> WireFrame:
    frames = [f for f in (random_frame(rng) for _ in range(rng.randint(0, 12))) if len(f.body) < 256]
    batch = relay_batch([f for f in frames if f.kind != RELAY_BATCH], 5, 6)
    body = batch.body[: rng.randint(0, len(batch.body))] if rng.random() < 0.2 else batch.body
    return WireFrame(RELAY_BATCH, rng.choice((254, 254, 254, 7)), 5, 6, body)


def test_random_wire_frames_are_the_same_to_both_sides(answers):
    """Whole streams: bodies good and bad under good checksums, batches, every kind and some unknown ones."""
    rng = random.Random(1)
    sent = [
        [random_batch(rng) if rng.random() < 0.15 else random_frame(rng) for _ in range(10)]
        for _ in range(400)
    ]
    said = agree(answers, [("s", b"".join(map(encode_frame, frames))) for frames in sent])
    kinds = {int(line.split()[1]) for answer in said for line in answer if line.startswith("packet")}
    assert kinds == set(PACKETS)
    seen = {Defect.UNKNOWN_KIND, Defect.BAD_LENGTH, Defect.BAD_VALUE, Defect.BAD_MODULE, Defect.TRUNCATED}
    assert set(drops(said)) == seen


def damaged(rng: random.Random, data: bytes) -> bytes:
    """The same bytes after a few losses, insertions, repetitions and turned bits."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(out) + 1)
        match rng.randrange(5):
            case 0:
                del out[at : at + rng.randint(1, 30)]
            case 1:
                out[at:at] = rng.randbytes(rng.randint(1, 30))
            case 2:
                out[at:at] = out[at : at + rng.randint(1, 60)]
            case 3 if at < len(out):
                out[at] ^= 1 << rng.randrange(8)
            case _:
                out[at : at + 1] = b"\x00"
    return bytes(out)


def test_damaged_byte_streams_are_the_same_to_both_sides(answers):
    rng = random.Random(2)
    streams = []
    for _ in range(1500):
        data = b"".join(encode_frame(random_frame(rng)) for _ in range(rng.randint(1, 6)))
        if rng.random() < 0.02:
            data += rng.randbytes(9000).replace(b"\x00", b"\x01") + b"\x00" + data
        streams.append(("s", damaged(rng, data)))
    counted = drops(agree(answers, streams))
    for defect in (Defect.BAD_CRC, Defect.BAD_STUFFING, Defect.TOO_SHORT, Defect.OVERLONG):
        assert counted[defect] >= 10, defect


def test_stuffing_at_its_edges_is_the_same_to_both_sides(answers):
    """Runs without a zero of every length near the full group, the largest wire frame, the overlong one."""
    sizes = [*range(230, 270), *range(490, 520), 4082, 4083]
    frames = [
        WireFrame(0x77, 3, 0x0101, 0x01010101, filler * size)
        for size in sizes
        for filler in (b"\x01", b"\x00")
    ]
    frames += [WireFrame(0x77, 3, 1, 1, b"\x01" * n + b"\x00" + b"\x02" * 300) for n in range(236, 252)]
    streams = [encode_frame(frame) for frame in frames]
    streams += [b"\x01" * n + b"\x00" + streams[0] for n in (4112, 4113, 4114, 4115, 9000)]
    streams += [bytes([n, 1, 2, 3, 0]) for n in range(1, 8)]
    agree(answers, [("s", data) for data in streams])


def damaged_traffic(rng: random.Random, frames: list[CanFrame]) -> bytes:
    """Records of CAN frames of which some were lost, repeated, swapped, changed or foreign."""
    out = list(frames)
    for _ in range(rng.randint(0, 4)):
        at = rng.randrange(len(out))
        match rng.randrange(5):
            case 0 if len(out) > 1:
                del out[at]
            case 1:
                out.insert(at, out[rng.randrange(len(out))])
            case 2:
                out.insert(rng.randrange(len(out)), out.pop(at))
            case 3:
                out[at] = CanFrame(
                    out[at].identifier ^ 1 << rng.randrange(29), out[at].data, is_fd=out[at].is_fd
                )
            case _:
                foreign = rng.randrange(4)
                out.insert(at, CanFrame(0x123, b"\x01" * 3, foreign == 0, False, foreign == 1, foreign == 2))
    data = pack_can_records(out)
    return damaged(rng, data) if rng.random() < 0.2 else data


def test_can_traffic_whole_and_damaged_is_the_same_to_both_sides(answers):
    rng = random.Random(3)
    cases = []
    for _ in range(1500):
        fd = rng.random() < 0.5
        frames = [random_frame(rng) for _ in range(rng.randint(1, 6))]
        pieces = [fragment(f, fd) for f in frames if len(f.body) <= (255 if fd else 245)]
        if pieces:
            mixed = [pieces[n].pop(0) for n in shuffled(rng, [len(p) for p in pieces])]
            cases.append(("c", damaged_traffic(rng, mixed)))
    said = agree(answers, cases)
    counted = drops(said)
    for defect in (Defect.LOST_FRAGMENT, Defect.FOREIGN, Defect.BAD_CRC, Defect.TRUNCATED, Defect.BAD_LENGTH):
        assert counted[defect] >= 10, defect
    assert sum(line.startswith("packet") for answer in said for line in answer) > 1000


def test_bytes_after_the_checksum_are_padding_on_can_fd_alone(answers):
    """Every length of padding, and every wrong body length, on both kinds of bus."""
    cases = []
    for size in (0, 2, 9, 30, 52, 60):
        for fd in (False, True):
            first, *rest = pieces = fragment(WireFrame(0x50, 3, 1, 2, bytes(size)), fd)
            last = pieces[-1]
            for extra in range(-3, 20):
                data = (last.data + bytes(20))[: max(0, len(last.data) + extra)][: 64 if fd else 8]
                changed = CanFrame(last.identifier, data, is_fd=fd)
                cases.append(("c", pack_can_records([*pieces[:-1], changed])))
            for length in range(256):
                begun = CanFrame(
                    first.identifier, first.data[:6] + bytes([length]) + first.data[7:], is_fd=fd
                )
                cases.append(("c", pack_can_records([begun, *rest])))
    counted = drops(agree(answers, cases))
    assert set(counted) == {Defect.BAD_LENGTH, Defect.BAD_CRC, Defect.TOO_SHORT}


def shuffled(rng: random.Random, counts: list[int]) -> list[int]:
    """Turns at random: number n as often as counts[n] says."""
    turns = [n for n, count in enumerate(counts) for _ in range(count)]
    rng.shuffle(turns)
    return turns


def test_more_senders_than_places_push_out_the_oldest_on_both_sides(answers):
    """300 wire frames begun and none finished, then all their second pieces."""
    frames = [WireFrame(0x10 + n // 64, n % 64, n, n, bytes(13)) for n in range(300)]
    pieces = [fragment(frame) for frame in frames]
    records = pack_can_records([p[0] for p in pieces] + [q for p in pieces for q in p[1:]])
    (said,) = agree(answers, [("c", records)])
    assert len(unpack_can_records(records)) == 900
    assert drops([said])[Defect.LOST_FRAGMENT] > 44


def test_a_receiver_with_little_memory_counts_what_it_cannot_hold(compile_c, tmp_path):
    """A buffer of 40 bytes takes short wire frames, drops a long one as overlong, and is whole again."""
    source = tmp_path / "little_memory.c"
    short, long = (encode_frame(WireFrame(0x42, 1, 2, 3, bytes([7]) * n)) for n in (2, 60))
    stream = ", ".join(map(str, short + long + short))
    source.write_text(
        '#include <stdio.h>\n#include "mocap_protocol.h"\nint main(void) {\n'
        f"static const uint8_t stream[] = {{{stream}}};\n"
        "uint8_t buffer[40]; mocap_frame_decoder d; mocap_wire_frame f; size_t i, n = 0;\n"
        "mocap_frame_decoder_init(&d, buffer, sizeof buffer);\n"
        "for (i = 0; i < sizeof stream; ++i) n += mocap_frame_decoder_push(&d, stream[i], &f) ? 1u : 0u;\n"
        "return n == 2u && d.accepted == 2u && d.dropped[MOCAP_OVERLONG] == 1u ? 0 : 1; }\n",
        encoding="utf-8",
    )
    assert subprocess.run([compile_c(source)], check=False, timeout=20).returncode == 0
