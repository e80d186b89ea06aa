"""A device that obeys by the C header: who is meant, duplicates, and when to answer."""

from __future__ import annotations

import random
import subprocess
from collections import OrderedDict
from pathlib import Path

import pytest

from firmware_protocol import Acknowledgement, Command, decode_body, encode_packet
from firmware_protocol.c.spelling import macro_name
from firmware_protocol.commands import ANSWER_MEMORY, VERBS, Result, Verb, decode_payload, encode_arguments
from firmware_protocol.framing import SUPPORTED, negotiate

HERE = Path(__file__).parent
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
OWN_MODULE = 9
OWN_ID = bytes(range(1, 13))
ANOTHER_ID = bytes(range(2, 14))
ANYONE = bytes(12)
ACK, BROADCAST = 0x51, 0xFF


@pytest.fixture(scope="module")
def driver(compile_c) -> Path:
    return compile_c(HERE / "command_driver.c", *SANITIZED)


def said_to(
    driver: Path, commands: list[tuple[int, Command]]
) -> list[tuple[str, int, Acknowledgement | None]]:
    """(what it did, delay in µs, its answer) for each (header module, command)."""
    bodies = ((module, encode_packet(command)) for module, command in commands)
    given = b"".join(bytes([module, len(body)]) + body for module, body in bodies)
    done = subprocess.run(
        [driver, str(OWN_MODULE)], input=given, capture_output=True, timeout=50, check=False
    )
    assert done.returncode == 0, done.stderr.decode()
    said = []
    for line in done.stdout.decode().splitlines():
        did, *rest = line.split()
        answer = decode_body(ACK, bytes.fromhex(rest[1])) if rest else None
        assert answer is None or isinstance(answer, Acknowledgement)
        said.append((did, int(rest[0]) if rest else 0, answer))
    assert len(said) == len(commands)
    return said


@pytest.mark.parametrize(
    ("module", "unique_id", "did", "delay_us"),
    [
        (OWN_MODULE, ANYONE, "obeyed", 0),
        (OWN_MODULE + 1, ANYONE, "ignored", 0),
        (BROADCAST, ANYONE, "obeyed", OWN_MODULE * 2000),
        (BROADCAST, OWN_ID, "obeyed", 0),
        (OWN_MODULE + 1, OWN_ID, "obeyed", 0),
        (BROADCAST, ANOTHER_ID, "ignored", 0),
        (OWN_MODULE, ANOTHER_ID, "ignored", 0),
        (OWN_MODULE, bytes(11) + b"\x01", "ignored", 0),
    ],
    ids=lambda value: value.hex() if isinstance(value, bytes) else None,
)
def test_the_device_that_is_meant_acts(driver: Path, module: int, unique_id: bytes, did: str, delay_us: int):
    ((what, delay, answer),) = said_to(driver, [(module, Command(1, Verb.START, unique_id))])
    assert (what, delay) == (did, delay_us)
    if did == "obeyed":
        assert answer == Acknowledgement(1, Verb.START, Result.DONE, OWN_ID, b"\x01")


def test_the_last_eight_commands_are_answered_again_without_acting(driver: Path):
    """Against an ordered dictionary of eight, over random repetitions."""
    rng = random.Random(10)
    commands = [
        (OWN_MODULE, Command(rng.randint(0, 11), rng.choice((Verb.START, Verb.STOP)))) for _ in range(500)
    ]
    remembered: OrderedDict[tuple[int, int], bytes] = OrderedDict()
    obeyed = 0
    seen = set()
    for (_, command), (did, _, answer) in zip(commands, said_to(driver, commands), strict=True):
        key = command.transaction, command.verb
        expected = "repeated" if key in remembered else "obeyed"
        if key not in remembered:
            obeyed = (obeyed + 1) % 256
            remembered[key] = bytes([obeyed])
            if len(remembered) > ANSWER_MEMORY:
                remembered.popitem(last=False)
        assert did == expected
        assert answer == Acknowledgement(*key, Result.DONE, OWN_ID, remembered[key])
        seen.add(did)
    assert seen == {"repeated", "obeyed"}


def test_versions_are_agreed_on_as_in_python(driver: Path):
    ranges = [(low, high) for low in range(4) for high in range(4)] + [(1, 255), (2, 255), (0, 0)]
    commands = [
        (OWN_MODULE, Command(n, Verb.HELLO, ANYONE, encode_arguments(Verb.HELLO, *r)))
        for n, r in enumerate(ranges)
    ]
    commands.append((OWN_MODULE, Command(100, Verb.HELLO, ANYONE, b"\x01")))
    *good, bad = said_to(driver, commands)
    for (low, high), (_, _, answer) in zip(ranges, good, strict=True):
        assert answer is not None
        assert decode_payload(Verb.HELLO, answer.payload) == (
            negotiate((low, high), SUPPORTED) or 0,
            *SUPPORTED,
        )
    assert bad[2] == Acknowledgement(100, Verb.HELLO, Result.BAD_ARGUMENTS, OWN_ID, b"")


def test_verbs_results_and_what_changes_the_device_are_those_declared(compile_c, tmp_path: Path):
    checks = [f"{macro_name('verb', v.name)} == {n}" for n, v in VERBS.items()]
    checks += [f"{macro_name('result', r.name)} == {int(r)}" for r in Result]
    checks += [
        f"mocap_verb_changes_device({n}) == {int(n in VERBS and VERBS[n].changes_device)}" for n in range(256)
    ]
    source = tmp_path / "verbs.c"
    source.write_text(
        '#include "mocap_protocol.h"\nint main(void) {\n'
        + "".join(f"if (!({check})) return 1;\n" for check in checks)
        + "return 0; }\n",
        encoding="utf-8",
    )
    assert subprocess.run([compile_c(source)], check=False, timeout=20).returncode == 0
    changing = {verb.name for verb in VERBS.values() if verb.changes_device}
    assert changing == {"WRITE_SETTING", "COMMIT", "FACTORY_RESET", "CARD_ERASE"}
