"""Signing in the C header against Python's BLAKE2s and its end of a signed link."""

from __future__ import annotations

import json
import random
import struct
import subprocess
from hashlib import blake2s

import pytest

from firmware_protocol import DELIMITER, Defect, WireFrame, encode_frame
from firmware_protocol.golden import VECTORS
from firmware_protocol.signing import HOST_SIGNER, KEY_SIZE, TAG_SIZE, SignedFrames
from tests.firmware_protocol.c.conftest import HERE, SANITIZED

DEFECTS = list(Defect)
GOLDEN = json.loads((VECTORS / "signing.json").read_text(encoding="utf-8"))
KEY = bytes.fromhex(GOLDEN["key"])
MODULE = 77


@pytest.fixture(scope="module")
def answers(compile_c):
    """The lines with which ``signing_driver.c`` answers each (what, key, signer, count, data)."""
    program = compile_c(HERE / "signing_driver.c", *SANITIZED)

    def answered(cases):
        given = b"".join(
            struct.pack("<cI32sIQ", what.encode(), 44 + len(data), key, signer, count) + data
            for what, key, signer, count, data in cases
        )
        done = subprocess.run([program], input=given, capture_output=True, timeout=100, check=False)
        assert done.returncode == 0, done.stderr.decode()
        return [answer.splitlines() for answer in done.stdout.decode().split("end\n")[:-1]]

    return answered


def test_tags_are_those_of_hashlib(answers):
    rng = random.Random(1)
    cases = [("h", rng.randbytes(KEY_SIZE), 1, 0, rng.randbytes(n)) for n in [*range(300), 4096, 5000]]
    expected = [[f"tag {blake2s(c[4], key=c[1], digest_size=TAG_SIZE).hexdigest()}"] for c in cases]
    assert answers(cases) == expected


def test_golden_vectors(answers):
    hashed = [("h", KEY, 1, 0, bytes.fromhex(vector["data"])) for vector in GOLDEN["blake2s"]]
    assert answers(hashed) == [[f"tag {vector['tag']}"] for vector in GOLDEN["blake2s"]]
    vectors = GOLDEN["from_host"]
    said = answers([("d", KEY, v["signer"], v["count"], bytes.fromhex(v["input"])) for v in vectors])
    for vector, lines in zip(vectors, said, strict=True):
        assert "".join(words(lines, "frame")) == vector["opened"], vector["name"]
        assert drops(lines) == vector["dropped"], vector["name"]
        assert words(lines, "count") == [str(vector["count_after"])], vector["name"]


def words(lines, name):
    return [line.split()[1] for line in lines if line.startswith(name)]


def drops(lines):
    pairs = [line.split()[1:] for line in lines if line.startswith("dropped")]
    return {DEFECTS[int(number) - 1].name: int(count) for number, count in pairs}


def test_what_a_module_signs_the_host_opens(answers):
    rng = random.Random(2)
    cases = [
        ("s", KEY, rng.randrange(1, 2**32), rng.randrange(2**48 - 1), encode_frame(random_frame(rng)))
        for _ in range(300)
    ]
    for (_, key, _, count, frame), lines in zip(cases, answers(cases), strict=True):
        host = SignedFrames(key)
        assert host.open(bytes.fromhex(words(lines, "signature")[0]) + frame) == frame
        assert host.count == count + 1


def test_a_key_that_is_used_up_signs_nothing(answers):
    assert answers([("s", KEY, MODULE, 2**48 - 1, b"\x01\x00")]) == [["signature "]]


def random_frame(rng):
    return WireFrame(rng.randrange(256), 3, rng.getrandbits(16), 5, rng.randbytes(rng.randint(0, 300)))


def test_damaged_streams_of_the_host_are_the_same_to_both_ends(answers):
    """Losses, repetitions, turned bits, wire frames without signature, other keys and old counts."""
    rng = random.Random(3)
    streams = [damaged(rng) for _ in range(800)]
    seen = set()
    for stream, lines in zip(streams, answers([("d", KEY, MODULE, 50, s) for s in streams]), strict=True):
        module = SignedFrames(KEY, MODULE, 50)
        opened = module.feed(stream)
        assert "".join(words(lines, "frame")) == opened.hex()
        assert drops(lines) == {defect.name: count for defect, count in module.dropped.items()}
        assert words(lines, "count") == [str(module.count)]
        seen |= set(module.dropped)
    assert seen == {Defect.UNSIGNED, Defect.BAD_SIGNATURE, Defect.REPLAYED, Defect.OUTDATED}


def damaged(rng):
    host, other = SignedFrames(KEY, HOST_SIGNER, rng.choice((10, 50))), SignedFrames(bytes(32))
    signed = [host.sign(encode_frame(random_frame(rng))) for _ in range(8)]
    for _ in range(rng.randint(0, 4)):
        at = rng.randrange(len(signed))
        match rng.randrange(5):
            case 0:
                signed.insert(at, signed[rng.randrange(len(signed))])
            case 1:
                signed.insert(at, other.sign(encode_frame(random_frame(rng))))
            case 2:
                signed[at] = signed[at].partition(DELIMITER)[2]
            case 3 if len(signed[at]) > 1:
                turned = bytearray(signed[at])
                turned[rng.randrange(len(turned))] ^= 1 << rng.randrange(8)
                signed[at] = bytes(turned)
            case _:
                signed[at] = signed[at][: rng.randrange(len(signed[at]) + 1)]
    return b"".join(signed)
