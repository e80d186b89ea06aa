"""What the tests of the C header share: a compiler, and a program that answers cases."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from firmware_protocol.c.generate import FOLDER
from firmware_protocol.c.records import record_of_fields
from firmware_protocol.c.spelling import c_name, snake
from firmware_protocol.commands import VERBS
from firmware_protocol.fields import Layout, layout_of
from firmware_protocol.packets import PACKETS

HERE = Path(__file__).parent
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")

Compile = Callable[..., Path]
Answers = Callable[[Iterable[tuple[str, bytes]]], list[list[str]]]


def compiler(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        reason = f"{name} is not installed, so the C header cannot be compiled"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    return found


@pytest.fixture(scope="session")
def compile_c(tmp_path_factory: pytest.TempPathFactory) -> Compile:
    """Compiles one source against the header: ``compile_c(source, *flags, name="gcc")``."""

    def compiled(source: Path, *flags: str, name: str = "gcc", strict: tuple[str, ...] = STRICT) -> Path:
        program = tmp_path_factory.mktemp("compiled") / source.stem
        command = [compiler(name), *strict, *flags, f"-I{FOLDER}", str(source), "-o", str(program)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == 0, f"{' '.join(command)}\n{done.stderr}"
        return program

    return compiled


@pytest.fixture(scope="session")
def answers(compile_c: Compile, tmp_path_factory: pytest.TempPathFactory) -> Answers:
    """The lines with which ``wire_driver.c`` answers each case, a case being (what, data)."""
    folder = tmp_path_factory.mktemp("wire_driver")
    (folder / "generated_fields.h").write_text(generated_fields(), encoding="utf-8")
    program = compile_c(HERE / "wire_driver.c", f"-I{folder}", *SANITIZED)

    def answered(cases: Iterable[tuple[str, bytes]]) -> list[list[str]]:
        given = b"".join(struct.pack("<cI", what.encode(), len(data)) + data for what, data in cases)
        done = subprocess.run([program], input=given, capture_output=True, timeout=100, check=False)
        assert done.returncode == 0, done.stderr.decode()
        *answered, rest = done.stdout.decode().split("end\n")
        assert not rest
        return [answer.splitlines() for answer in answered]

    return answered


def generated_fields() -> str:
    """C that prints every field of every packet as the struct holds it, and recodes what goes with verbs."""
    cases = "".join(
        f"case {kind}: {{ const {c_name(cls.__name__)} *v = &packet->as.{snake(cls.__name__)};\n"
        + "".join(print_field(layout_of(cls), place) for place in range(len(layout_of(cls).fields)))
        + "break; }\n"
        for kind, cls in PACKETS.items()
    )
    recoded = "".join(
        f"if (verb == {number} && part == '{part}') {{ {c_name(name)} v; uint8_t out[256];\n"
        f"const mocap_defect defect = {c_name('decode', name)}(data, size, &v);\n"
        'if (defect != MOCAP_GOOD) { printf("defect %u\\n", (unsigned)defect); return; }\n'
        f'print_bytes("bytes", out, {c_name("encode", name)}(&v, out, sizeof out)); return; }}\n'
        for number, part, name in verb_records()
    )
    return (
        "static void print_packet(const mocap_packet *packet) { size_t i; (void)i; switch (packet->kind) {\n"
        + cases
        + 'default: break; } printf("\\n"); }\n'
        + "static void recode_verb(uint8_t verb, char part, const uint8_t *data, size_t size) {\n"
        + recoded
        + 'printf("none\\n"); }\n'
    )


def print_field(layout: Layout, place: int) -> str:
    """C that prints one field: integers in decimal, floats as their bits, bytes in hex."""
    declared = layout.fields[place]
    value = f"v->{declared.name}"
    if declared.code == "s":
        size = f"{value}_size" if declared.is_rest else str(declared.count)
        printed = f'printf("x"); print_hex({value}, {size}); printf(" ");'
    else:
        element = f"{value}[i]" if declared.count > 1 else value
        one = f'printf("%lld ", (long long){element});'
        if declared.code == "f":
            one = f'{{ uint32_t b; memcpy(&b, &{element}, 4); printf("f%08lx ", (unsigned long)b); }}'
        printed = f"for (i = 0; i < {declared.count}u; ++i) {one}" if declared.count > 1 else one
    if declared.presence_bit is not None:
        return f"if (v->mask >> {declared.presence_bit} & 1) {{ {printed} }}\n"
    return printed + "\n"


def verb_records() -> list[tuple[int, str, str]]:
    """(verb, part, struct) for all that goes with verbs."""
    found = []
    for number, declared in VERBS.items():
        for part in ("arguments", "payload", "entries"):
            fields = getattr(declared, part)
            if fields:
                name = "entry" if part == "entries" else part
                found.append((number, part[0], record_of_fields(f"{declared.name}_{name}", "", fields).name))
    return found
