"""What the C structs hold: every field where its declaration says, limits, factory values, SI units."""

from __future__ import annotations

import json
import math
import random
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_protocol import Defect, InertialSample, InertialSampleFine, decode_body, encode_packet
from firmware_protocol.c.spelling import c_name, snake
from firmware_protocol.commands import VERBS, decode_arguments, decode_payload
from firmware_protocol.device_settings import SETTINGS, decode_value, encode_value
from firmware_protocol.fields import INTEGER_RANGE, WireField, layout_of
from firmware_protocol.golden import VECTORS
from firmware_protocol.packets import PACKETS

DEFECTS = list(Defect)


def distinct_body(kind: int, mask: int, rng: random.Random) -> tuple[bytes, list[str]]:
    """A body whose elements all differ, and how the driver prints them. Independent of the codec."""
    layout = layout_of(PACKETS[kind])
    body = bytes([mask]) if layout.has_mask else b""
    printed = []
    for declared in layout.present(mask):
        if declared.code == "s":
            size = declared.count or declared.max_size or 0
            data = bytes(rng.randint(0x20, 0x7E) for _ in range(size))
            printed.append(f"x{data.hex()}")
        else:
            elements = [allowed(declared, rng) for _ in range(declared.count)]
            data = struct.pack(f"<{declared.count}{declared.code}", *elements)
            words = struct.unpack(f"<{declared.count}I", data) if declared.code == "f" else elements
            printed += [f"f{word:08x}" if declared.code == "f" else str(word) for word in words]
        body += data
    return body, printed


def allowed(declared: WireField, rng: random.Random) -> Any:
    if declared.code == "f":
        return abs(rng.gauss(0, 100))
    if declared.meanings:
        return rng.choice(list(declared.meanings))
    low, high = INTEGER_RANGE[declared.code]
    return rng.randint(low, high if declared.maximum is None else int(declared.maximum))


def test_every_field_of_every_packet_lies_where_it_is_declared(answers):
    rng = random.Random(4)
    cases, wanted = [], []
    for kind, cls in PACKETS.items():
        for mask in layout_of(cls).valid_masks():
            body, printed = distinct_body(kind, mask, rng)
            cases.append(("p", bytes([kind]) + body))
            wanted.append([" ".join(printed), f"body {body.hex()}"])
    said = answers(cases)
    assert [[line.rstrip() for line in answer] for answer in said] == wanted


def limit_elements(declared: WireField) -> Iterator[Any]:
    """Elements at, inside and outside every limit."""
    if declared.code == "f":
        yield from (0.0, -0.0, 1.5, -1e-30, math.inf, -math.inf, math.nan, 3.4e38)
        return
    low, high = INTEGER_RANGE[declared.code]
    scale = declared.scale or 1
    limits = [x / scale for x in (declared.minimum, declared.maximum) if x is not None]
    near = {round(x) + d for x in [*limits, *declared.meanings, low, high, 0] for d in (-2, -1, 0, 1, 2)}
    near |= set(range(256)) if high == 255 else set()
    yield from sorted(x for x in near if low <= x <= high)


def test_every_limit_of_every_packet_is_that_of_the_declaration(answers):
    rng = random.Random(5)
    cases = []
    for kind, cls in PACKETS.items():
        layout = layout_of(cls)
        mask = max(layout.valid_masks())
        body, _ = distinct_body(kind, mask, rng)
        at = 1 if layout.has_mask else 0
        for declared in layout.present(mask):
            for element in limit_elements(declared) if declared.code != "s" else ():
                one = struct.pack(f"<{declared.code}", element)
                last = at + declared.size - len(one)
                cases += [("p", bytes([kind]) + body[:p] + one + body[p + len(one) :]) for p in {at, last}]
            at += declared.size
        cases += [("p", bytes([kind]) + body[:n]) for n in range(len(body))]
        cases += [("p", bytes([kind, m]) + body[1:]) for m in range(256) if layout.has_mask]
        cases.append(("p", bytes([kind]) + body + b"\x20"))
    for (_, data), said in zip(cases, answers(cases), strict=True):
        packet = decode_body(data[0], data[1:])
        refused = [f"defect {DEFECTS.index(packet) + 1}"] if isinstance(packet, Defect) else None
        assert said == refused if refused else said[-1] == f"body {data[1:].hex()}", data.hex()


@pytest.mark.parametrize(
    "text", [b"\xc0\x80", b"\xed\xa0\x80", b"\xf4\x90\x80\x80", b"\xe0\x9f\xbf", b"\xc3", b"a\x00b"]
)
def test_what_is_no_text_is_none_to_both_sides(answers, text: bytes):
    body = b"\x03" + text
    assert decode_body(0x33, body) is Defect.BAD_VALUE
    assert answers([("p", b"\x33" + body)]) == [[f"defect {DEFECTS.index(Defect.BAD_VALUE) + 1}"]]


def test_every_two_and_three_bytes_are_text_to_both_sides_or_to_neither(answers):
    samples = [bytes([a, b]) for a in range(256) for b in (0, 0x7F, 0x80, 0x9F, 0xA0, 0xBF, 0xC0, 0xFF)]
    samples += [
        bytes([a, b, c, 0x80]) for a in range(0xC0, 0x100) for b in range(0x70, 0xD0, 8) for c in (0x7F, 0x80)
    ]
    for sample, said in zip(samples, answers([("p", b"\x33\x01" + s) for s in samples]), strict=True):
        assert said[0].startswith("defect") == isinstance(decode_body(0x33, b"\x01" + sample), Defect), (
            sample.hex()
        )


def test_arguments_payloads_and_entries_of_golden_commands_come_back(answers):
    vectors = json.loads((VECTORS / "commands.json").read_text(encoding="utf-8"))["vectors"]
    cases, wanted = [], []
    for vector in vectors:
        verb = VERBS[vector["verb"]]
        entry_size = sum(f.size for f in verb.entries)
        for part, fields in (("arguments", verb.arguments), ("payload", verb.payload)):
            data = bytes.fromhex(vector[part]["bytes"])
            if part == "payload" and entry_size:
                start = sum(f.size for f in fields)
                entries = [data[at : at + entry_size] for at in range(start, len(data), entry_size)]
                cases += [("v", bytes([verb.verb]) + b"e" + entry) for entry in entries]
                wanted += [[f"bytes {entry.hex()}"] for entry in entries]
                data = data[:start]
            cases.append(("v", bytes([verb.verb]) + part[:1].encode() + data))
            wanted.append([f"bytes {data.hex()}"] if fields else ["none"])
    assert {vector["verb"] for vector in vectors} == set(VERBS)
    assert answers(cases) == wanted


def test_random_arguments_and_payloads_are_good_to_both_sides_or_to_neither(answers):
    rng = random.Random(6)
    cases = [
        (verb, part, rng.randbytes(rng.randint(0, 14)))
        for _ in range(150)
        for verb, declared in VERBS.items()
        for part in ("a", "p")
        if not declared.entries and (declared.arguments if part == "a" else declared.payload)
    ]
    cases += [(14, "a", struct.pack("<I", 0x46414354 + step)) for step in (-1, 0, 1)]
    cases += [(21, "a", bytes(6) + bytes([length])) for length in (0, 191, 192, 193, 255)]
    cases += [(21, "p", bytes(6 + length)) for length in (0, 191, 192, 193)]
    said = answers([("v", bytes([verb]) + part.encode() + data) for verb, part, data in cases])
    for (verb, part, data), answer in zip(cases, said, strict=True):
        values = (decode_arguments if part == "a" else decode_payload)(verb, data)
        assert (answer == [f"bytes {data.hex()}"]) == (values is not None), (verb, part, data.hex(), answer)
        assert answer[0].startswith("bytes") or answer[0].startswith("defect")


def settings_bytes() -> Iterator[tuple[int, bytes]]:
    rng = random.Random(7)
    for vector in json.loads((VECTORS / "settings.json").read_text(encoding="utf-8"))["vectors"]:
        yield vector["key"], bytes.fromhex(vector["bytes"])
    for key, setting in SETTINGS.items():
        declared = setting.value
        good = encode_value(key, setting.factory)
        yield key, good[:-1]
        yield key, good + b"\x00"
        for element in limit_elements(declared) if declared.code != "s" else ():
            one = struct.pack(f"<{declared.code}", element)
            yield key, one + good[len(one) :]
            yield key, good[: -len(one)] + one
        for _ in range(100 if declared.code == "s" else 0):
            yield key, rng.randbytes(rng.randint(0, declared.count)).ljust(declared.count, b"\x00")
    yield from ((key, b"\x01") for key in (0, 11, 255))


def test_every_setting_is_taken_or_refused_as_in_python(answers):
    cases = list(settings_bytes())
    said = answers([("k", bytes([key]) + data) for key, data in cases])
    results = set()
    for (key, data), (result, value, valid) in zip(cases, said, strict=True):
        if key not in SETTINGS:
            wanted, kept = 6, b""
        elif decode_value(key, data) is None:
            wanted, kept = 2, encode_value(key, SETTINGS[key].factory)
        else:
            wanted, kept = 0, data
        assert (result, value, valid) == (f"result {wanted}", f"value {kept.hex()}", "valid 1")
        results.add(wanted)
    assert results == {0, 2, 6}


SI_DRIVER = """
#include <stdio.h>
#include "mocap_protocol.h"
int main(void) {{
    double v[9];
    uint8_t body[64];
    while (fread(v, sizeof v[0], 9, stdin) == 9u) {{
        {type} sample;
        size_t i, size;
        memset(&sample, 0, sizeof sample);
        {type}_set_specific_force_si(&sample, (MOCAP_REAL)v[0], (MOCAP_REAL)v[1], (MOCAP_REAL)v[2]);
        {type}_set_magnetic_field_si(&sample, (MOCAP_REAL)v[3], (MOCAP_REAL)v[4], (MOCAP_REAL)v[5]);
        {type}_set_angular_rate_si(&sample, (MOCAP_REAL)v[6], (MOCAP_REAL)v[7], (MOCAP_REAL)v[8]);
        size = mocap_encode_{name}(&sample, body, sizeof body);
        for (i = 0; i < size; ++i) printf("%02x", body[i]);
        printf("\\n");
    }}
    return 0;
}}
"""


@pytest.mark.parametrize("cls", [InertialSample, InertialSampleFine])
@pytest.mark.parametrize("real", ["float", "double"])
def test_readings_in_si_are_quantised_and_clipped_as_in_python(compile_c, tmp_path: Path, cls, real: str):
    """In double exactly; in float within the resolution of a float, and one step."""
    rng = random.Random(8)
    layout = layout_of(cls)
    ends = [f.scale * INTEGER_RANGE[f.code][1] for f in layout.fields for _ in range(3)]
    readings = [[end * rng.uniform(-1.2, 1.2) * 10 ** rng.uniform(-4, 0) for end in ends] for _ in range(400)]
    # Half a step and more beyond the last one: the nearest number is out of reach.
    steps = [f.scale for f in layout.fields for _ in range(3)]
    beyond = (0.4, 0.6, 1.4)
    readings += [[s * (e + n * t) for e, t in zip(ends, steps, strict=True)] for n in beyond for s in (1, -1)]
    readings += [[end * factor for end in ends] for factor in (1, -1, 1.1, -1.1, 0, 1e30, -1e30)]
    source = tmp_path / "si.c"
    source.write_text(SI_DRIVER.format(type=c_name(cls.__name__), name=snake(cls.__name__)), encoding="utf-8")
    program = compile_c(source, f"-DMOCAP_REAL={real}", "-fsanitize=undefined", "-fno-sanitize-recover=all")
    given = b"".join(struct.pack("<9d", *reading) for reading in readings)
    said = (
        subprocess.run([program], input=given, capture_output=True, check=True, timeout=20)
        .stdout.decode()
        .split()
    )
    for reading, line in zip(readings, said, strict=True):
        wanted = encode_packet(cls(tuple(reading[:3]), tuple(reading[3:6]), tuple(reading[6:])))
        if real == "double":
            assert line == wanted.hex(), reading
            continue
        shape = layout.struct_format(7)
        got, exact = struct.unpack(shape, bytes.fromhex(line)), struct.unpack(shape, wanted)
        near = 2**-22 if cls is InertialSampleFine else 0
        assert all(abs(a - b) <= 1 + near * abs(b) for a, b in zip(got[1:], exact[1:], strict=True)), reading


def scaled_fields() -> list[tuple[str, WireField]]:
    found = [
        (cls.__name__, f) for cls in PACKETS.values() for f in layout_of(cls).fields if f.scale is not None
    ]
    return found + [("settings", s.value) for s in SETTINGS.values() if s.value.scale is not None]


def test_every_scaled_field_goes_to_si_and_back(compile_c, tmp_path: Path):
    """Each to SI as Python has it; each number that stands for a value comes back as itself."""
    lines, wanted = [], []
    for name, declared in scaled_fields():
        low, high = INTEGER_RANGE[declared.code]
        function = c_name(name, declared.name)
        numbers = {low + 1, -1, 0, 1, 15, 100, 1569, high // 3, high - 1}
        for raw in sorted(n for n in numbers if low <= n <= high and n != declared.absent):
            value = raw * declared.scale
            back = (
                raw if declared.accepts(value if declared.count == 1 else (value,) * declared.count) else None
            )
            lines.append(
                f'printf("%.17g %lld\\n", {function}_to_si({raw}), (long long){function}_from_si({value!r}));'
            )
            wanted.append((value, back))
    assert len(wanted) > 100
    source = tmp_path / "scaled.c"
    source.write_text(
        '#include <stdio.h>\n#define MOCAP_REAL double\n#include "mocap_protocol.h"\nint main(void) {\n'
        + "\n".join(lines)
        + "\nreturn 0; }\n",
        encoding="utf-8",
    )
    printed = subprocess.run([compile_c(source)], capture_output=True, check=True, timeout=20).stdout.decode()
    for line, (value, back) in zip(printed.splitlines(), wanted, strict=True):
        to_si, from_si = line.split()
        assert float(to_si) == value
        assert back is None or int(from_si) == back


def test_what_is_beyond_a_setting_becomes_its_nearest_end(compile_c, tmp_path: Path):
    source = tmp_path / "ends.c"
    source.write_text(
        '#include <stdio.h>\n#include "mocap_protocol.h"\nint main(void) {\n'
        "return mocap_settings_sampling_rate_from_si(0.0f) == MOCAP_SETTINGS_SAMPLING_RATE_MIN\n"
        "    && mocap_settings_sampling_rate_from_si(1e9f) == MOCAP_SETTINGS_SAMPLING_RATE_MAX\n"
        "    && mocap_settings_sampling_rate_from_si(100.04f) == 1000u\n"
        "    && mocap_settings_sampling_rate_from_si(100.06f) == 1001u ? 0 : 1; }\n",
        encoding="utf-8",
    )
    assert subprocess.run([compile_c(source)], check=False, timeout=20).returncode == 0
    assert encode_value(2, 1.0) == struct.pack("<H", 10)
