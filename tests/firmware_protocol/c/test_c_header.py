"""The committed header: what would be generated, accepted by strict compilers, without state of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from firmware_protocol import FrameDecoder, InertialSample, PacketDecoder
from firmware_protocol.c.generate import FOLDER, HEADER, header_source
from firmware_protocol.c.spelling import ascii_text

INCLUDED = '#include "mocap_protocol.h"\n#include "mocap_protocol.h"\nint main(void) { return 0; }\n'

EVERY_WARNING = (
    "-Wconversion",
    "-Wsign-conversion",
    "-Wshadow",
    "-Wcast-qual",
    "-Wundef",
    "-Wdouble-promotion",
)


def test_the_committed_header_is_what_would_be_generated():
    """To bring it up to date: python -m firmware_protocol.c.generate."""
    assert HEADER.read_text(encoding="utf-8") == header_source()


def test_the_header_is_ascii_and_includes_the_standard_library_alone():
    source = HEADER.read_text(encoding="utf-8")
    assert source.isascii()
    included = {line.split()[1] for line in source.splitlines() if line.startswith("#include")}
    assert included == {"<stdbool.h>", "<stddef.h>", "<stdint.h>", "<string.h>"}
    assert "malloc" not in source


def test_what_has_no_ascii_spelling_is_refused():
    assert ascii_text("9.81 m/s², 25 °C") == "9.81 m/s^2, 25 degC"
    with pytest.raises(ValueError, match="no ASCII spelling"):
        ascii_text("漢")


@pytest.mark.parametrize(
    ("name", "standard", "suffix"),
    [("gcc", "c99", "c"), ("gcc", "c11", "c"), ("g++", "c++11", "cpp"), ("g++", "c++20", "cpp")],
)
def test_the_header_compiles_without_a_warning(
    compile_c, tmp_path: Path, name: str, standard: str, suffix: str
):
    source = tmp_path / f"included.{suffix}"
    source.write_text(INCLUDED, encoding="utf-8")
    strict = (f"-std={standard}", "-Wall", "-Wextra", "-Werror", "-pedantic", *EVERY_WARNING)
    compile_c(source, name=name, strict=strict)
    compile_c(source, "-DMOCAP_CRC_BITWISE", "-DMOCAP_CAN_BODY_CAPACITY=32u", name=name, strict=strict)


def test_two_sources_that_include_it_link_and_neither_holds_state(compile_c, tmp_path: Path):
    """Everything is static inline, so an object holds what it uses, and no variable."""
    source = tmp_path / "uses.c"
    source.write_text(
        '#include "mocap_protocol.h"\n'
        "size_t send(const mocap_wire_frame *f, uint8_t *o, size_t n)"
        " { return mocap_encode_frame(f, o, n); }\n"
        "bool take(mocap_frame_decoder *d, uint8_t b, mocap_wire_frame *f)"
        " { return mocap_frame_decoder_push(d, b, f); }\n",
        encoding="utf-8",
    )
    object_file = compile_c(source, "-c", "-Os")
    if shutil.which("nm") is None:
        pytest.skip("nm is not installed, so symbols cannot be listed")
    listed = subprocess.run(
        ["nm", object_file], capture_output=True, text=True, check=True, timeout=20
    ).stdout
    symbols = [line.split()[-2:] for line in listed.splitlines()]
    assert {name for kind, name in symbols if kind == "T"} == {"send", "take"}
    assert not [name for kind, name in symbols if kind in "BbDdCc"]


@pytest.mark.parametrize("flags", [(), ("-DMOCAP_CRC_BITWISE",), ("-DMOCAP_REAL=double",)])
def test_the_example_sends_a_sample_that_is_received(compile_c, flags: tuple[str, ...]):
    program = compile_c(FOLDER / "example.c", *flags)
    sent = subprocess.run([program], capture_output=True, check=True, timeout=20).stdout
    decoder = PacketDecoder(FrameDecoder())
    (received,) = decoder.feed(sent)
    assert not decoder.dropped
    assert (received.module, received.sequence, received.module_time_us) == (3, 17, 1_250_000)
    assert isinstance(received.packet, InertialSample)
    assert received.packet.specific_force == pytest.approx((0.0, 0.0, 9.81), abs=16 * 9.80665 / 2**15 / 2)
    assert received.packet.angular_rate == pytest.approx((0.0, 0.1, 0.0), abs=1e-3)
    assert received.packet.magnetic_field is None


def test_under_continuous_integration_a_missing_compiler_is_a_failure(compile_c, monkeypatch, tmp_path: Path):
    source = tmp_path / "empty.c"
    source.write_text("int main(void) { return 0; }\n", encoding="utf-8")
    monkeypatch.setitem(os.environ, "CI", "true")
    with pytest.raises(pytest.fail.Exception, match="not installed"):
        compile_c(source, name="no-such-compiler")
    monkeypatch.setitem(os.environ, "CI", "")
    with pytest.raises(pytest.skip.Exception, match="not installed"):
        compile_c(source, name="no-such-compiler")
