"""Whatever comes on the line: the reference answers valid wire frames alone, and as the emulator does.

The module is built with the compiler's checks of memory and arithmetic, which end it at the first fault.
Each wire frame is shown to the emulator's commands too (``twin``), and answers are compared byte by byte.
"""

from __future__ import annotations

import itertools
import os
import select
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import pytest

from devices.emulators.device.emulated_flash import KEYS
from devices.emulators.device.firmware_memory import FirmwareMemory
from devices.emulators.faults.wire_damage import BYTE_DAMAGES
from firmware_protocol import (
    BROADCAST,
    PACKETS,
    Acknowledgement,
    Command,
    FrameDecoder,
    PacketDecoder,
    SyncRequest,
    SyncResponse,
    WireFrame,
    encode_frame,
)
from firmware_protocol.commands import ANSWER_MEMORY, FACTORY_RESET_MAGIC, Verb
from firmware_protocol.device_settings import SETTINGS, encode_value, factory_settings
from firmware_protocol.fields import INTEGER_RANGE
from firmware_protocol.messages import ANYONE
from firmware_protocol.packets import encode_packet
from tests.firmware.machines import POSIX, Machine, NotHere, build, switched_on
from tests.firmware.twin import FUSED, Twin, is_fused
from tests.patience import PATIENCE_S

pytestmark = [pytest.mark.system]

CHECKED = "-fsanitize=address,undefined -fno-sanitize-recover=all"
UNIQUE_ID = bytes(range(1, 13))
SEED = int(os.environ.get("FIRMWARE_SEED", "28"))
MOST_ANSWERS = ANSWER_MEMORY - 2
"""In a batch: a module remembers so few answers, and those to a broadcast wait."""
BATCH = 64
ANSWERED_S = 0.2
"""Longer than any answer waits, 2 ms times the highest id."""
VERBS = tuple(VERB for VERB in (*range(25), 200, 255) for _ in range(1 if VERB in (12, 14) else 20))
"""Commits take a chip's time: they are rare."""


class Line:
    """The host's side of a module's line."""

    def __init__(self, machine: Machine) -> None:
        self.twin = Twin(UNIQUE_ID)
        self.decoder = PacketDecoder(FrameDecoder())
        self.n_answers = 0
        self._machine = machine
        self._seen = FrameDecoder()
        self._wanted: Counter[bytes | int] = Counter()
        self._allowed: Counter[bytes | int] = Counter()
        """To a command that came again while its answer still waited: one answer may do for both."""
        self._allowed_s = 0.0
        self._file = os.open(machine.url, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def close(self) -> None:
        os.close(self._file)

    def expect(self, data: bytes) -> int:
        """Show bytes to the emulator; how many answers are still to come."""
        if time.monotonic() > self._allowed_s:
            self._allowed.clear()
        for entry in self._seen.entries(data):
            answer = self.twin.answer(entry)
            if answer is not None:
                told = answer if isinstance(answer, int) else encode_packet(answer)
                is_again = isinstance(answer, Acknowledgement) and self._wanted[told] > 0
                (self._allowed if is_again else self._wanted)[told] += 1
                self._allowed_s = time.monotonic() + ANSWERED_S if is_again else self._allowed_s
        return self._wanted.total()

    def exchange(self, data: bytes, quiet_s: float = 0.0) -> None:
        """Send bytes, and take in the answers until all have come, and then for so long.

        Fails where one does not come, or is another."""
        end = time.monotonic() + PATIENCE_S
        while data or self._wanted.total():
            assert self._machine.is_on, self._machine.printed
            assert time.monotonic() < end, f"unanswered: {self._wanted}"
            data = self._pass(data, 0.05)
        end = time.monotonic() + quiet_s
        while time.monotonic() < end:
            self._pass(b"", 0.01)

    def _pass(self, data: bytes, patience_s: float) -> bytes:
        readable, writable, _ = select.select([self._file], [self._file] if data else [], [], patience_s)
        if readable:
            self._take(os.read(self._file, 65536))
        return data[os.write(self._file, data[:256]) :] if writable else data

    def _take(self, data: bytes) -> None:
        for received in self.decoder.feed(data):
            packet = received.packet
            if isinstance(packet, Acknowledgement | SyncResponse):
                told = packet.token if isinstance(packet, SyncResponse) else encode_packet(packet)
                due = self._wanted if self._wanted[told] else self._allowed
                assert due[told], f"{packet} was not to come, but {self._wanted}"
                due[told] -= 1
                self.n_answers += 1


@pytest.fixture(scope="session")
def checked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The module with the compiler's checks in it."""
    try:
        return build(POSIX, tmp_path_factory.mktemp("checked"), flags=CHECKED)
    except NotHere as missing:
        pytest.skip(str(missing))


@pytest.fixture
def line(checked: Path, tmp_path: Path) -> Iterator[Line]:
    """A module from the factory on its line."""
    memory = FirmwareMemory.fresh(tmp_path / "m.img", UNIQUE_ID)
    with switched_on(Machine(checked, memory, tmp_path / "m")) as machine:
        line = Line(machine)
        line.exchange(b"\0", quiet_s=0.2)
        line.decoder = PacketDecoder(FrameDecoder())  # the line may have been opened within a wire frame
        yield line
        line.close()
        assert machine.is_on, machine.printed


def framed(packet: Command | SyncRequest, module: int = BROADCAST) -> bytes:
    return encode_frame(WireFrame(packet.KIND, module, 0, 0, encode_packet(packet)))


def odd_values(key: int) -> Iterator[bytes]:
    """Yield bytes for a setting: the factory's, its limits and beyond, too short, too long, not finite."""
    declared = SETTINGS[key].value
    right = encode_value(key, factory_settings()[key])
    yield from (right, right[:-1], right + b"\0", b"")
    if declared.code == "f":
        odd = (0.0, -0.0, 1.5, float("nan"), float("inf"), -1e38)
        yield from (struct.pack("<f", value) + right[4:] for value in odd)
        yield from (right[:-4] + struct.pack("<f", value) for value in odd)
    elif declared.is_text:
        for text in ("x" * 16, "x\0y", "é" * 8, "\ud7ff", "𝄞" * 4):
            yield text.encode(errors="replace").ljust(16, b"\0")[:16]
        yield from (
            b"\xff" * 16,
            b"\xc3".rjust(16, b"x"),
            b"\xed\xa0\x80".ljust(16, b"\0"),
            b"\0" + b"x" * 15,
        )
    else:
        lowest, highest = INTEGER_RANGE[declared.code]
        limits = [limit for limit in (declared.minimum, declared.maximum) if limit is not None]
        steps = {round(limit / (declared.scale or 1.0)) + off for limit in limits for off in (-1, 0, 1)}
        for value in sorted({lowest, highest, 1, 2, 3, *steps}):
            if lowest <= value <= highest:
                yield struct.pack(f"<{declared.code}", value)


def arguments_of(verb: int) -> Iterator[bytes]:
    """Yield arguments of every length about the right one, and of every value about its limits."""
    yield from (bytes(size) for size in (*range(40), 190, 192, 193, 200))
    yield from (b"\xff" * size for size in range(12))
    if verb == Verb.HELLO:
        yield from (bytes(pair) for pair in itertools.product((0, 1, 2, 200, 255), repeat=2))
    elif verb == Verb.READ_SETTING:
        yield from (bytes([key]) for key in range(256))
    elif verb == Verb.WRITE_SETTING:
        yield from (bytes([key]) + value for key in SETTINGS for value in odd_values(key))
        yield from (bytes([key, 0]) for key in range(256) if key not in SETTINGS)
    elif verb == Verb.FACTORY_RESET:
        yield from (struct.pack(order, FACTORY_RESET_MAGIC) for order in ("<I", ">I"))


def test_both_answer_every_command_of_the_table_alike(line, figure):
    """With all arguments that may be thought of; what is staged is committed and read back in between."""
    transaction = itertools.count(1)
    n = 0
    for verb in range(256):
        for arguments in arguments_of(verb) if verb in (*Verb, 0, 6, 255) else (b"", b"\0"):
            if verb == Verb.WRITE_SETTING and arguments == bytes([KEYS["mode"]]) + FUSED:
                continue
            data = framed(Command(next(transaction) % 65536, verb, UNIQUE_ID, arguments))
            line.expect(data)
            line.exchange(data)
            n += 1
    for key, value in ((k, v) for k in SETTINGS for v in odd_values(k)):
        if (key, value) == (KEYS["mode"], FUSED):
            continue
        for verb, arguments in ((Verb.WRITE_SETTING, bytes([key]) + value), (Verb.COMMIT, b"")):
            data = framed(Command(next(transaction) % 65536, verb, UNIQUE_ID, arguments))
            line.expect(data)
            line.exchange(data)
            n += 1
    line.exchange(b"", quiet_s=0.3)
    assert not line.decoder.dropped
    figure("Answers of the reference module beside those of the emulator, posix", f"{n} commands, all alike")


class Speech:
    """What a confused host says: commands and the rest, good, damaged, and good with a wrong body."""

    def __init__(self, rng: Random, line: Line) -> None:
        self._rng, self._line = rng, line
        self._transaction = 0
        self._before = framed(Command(0, Verb.HELLO, ANYONE, b"\1\1"))
        self.n_damaged = 0

    def frame(self) -> bytes:
        """Return the bytes of the next wire frame, or what is left of it."""
        rng, twin = self._rng, self._line.twin
        module = rng.choices((twin.module, BROADCAST, rng.randrange(256)), (90, 2, 8))[0]
        kind, body = rng.choices((self._command, self._request, self._other), (80, 10, 10))[0]()
        if rng.random() < 0.4:
            self.n_damaged += 1
            body = self._spoilt(body)
        if kind == Command.KIND and is_fused(body):
            return b""
        data = encode_frame(WireFrame(kind, module, rng.randrange(65536), rng.randrange(2**32), body))
        before, self._before = self._before, data
        if rng.random() < 0.4:
            self.n_damaged += 1
            return b"".join(rng.choice(BYTE_DAMAGES)(rng, data, before))
        return data

    def _command(self) -> tuple[int, bytes]:
        rng = self._rng
        verb = rng.choice(VERBS)
        arguments = rng.choice(_ARGUMENTS[verb])
        uid = rng.choices((ANYONE, UNIQUE_ID, rng.randbytes(12)), (6, 3, 1))[0]
        if rng.random() < 0.85:
            self._transaction += 1
        transaction = (self._transaction - rng.choice((0, 0, 0, 1, 5, 12))) % 65536
        return Command.KIND, encode_packet(Command(transaction, verb, uid, arguments))

    def _request(self) -> tuple[int, bytes]:
        rng = self._rng
        return SyncRequest.KIND, encode_packet(SyncRequest(rng.randrange(65536), rng.randrange(2**64)))

    def _other(self) -> tuple[int, bytes]:
        rng = self._rng
        return rng.choice((*PACKETS, rng.randrange(256))), rng.randbytes(rng.randrange(60))

    def _spoilt(self, body: bytes) -> bytes:
        rng, spoilt = self._rng, bytearray(body)
        for _ in range(rng.choice((0, 1, 1, 2, 8))):
            if spoilt:
                spoilt[rng.randrange(len(spoilt))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        cut = rng.choice((None, None, rng.randrange(len(spoilt) + 1)))
        return bytes(spoilt[:cut]) + rng.choice((b"", b"", rng.randbytes(rng.choice((1, 4, 200)))))


_ARGUMENTS = {verb: list(arguments_of(verb)) for verb in set(VERBS)}


def told(line: Line, n: int) -> Speech:
    """Say n wire frames to a module, and look at all that it answers."""
    speech = Speech(Random(SEED), line)
    n_said = 0
    while n_said < n:
        batch = b""
        for _ in range(BATCH):
            data = speech.frame()
            batch += data
            n_said += 1
            if line.expect(data) >= MOST_ANSWERS:
                break
        line.exchange(batch)
    line.exchange(b"", quiet_s=0.3)
    hello = framed(Command(65535, Verb.HELLO, UNIQUE_ID, b"\1\1"))
    line.expect(b"\0" + hello)
    line.exchange(b"\0" + hello)
    assert not line.decoder.dropped
    return speech


def test_only_valid_frames_are_answered_and_nothing_breaks(line):
    told(line, 20_000)
    assert line.n_answers > 3000


@pytest.mark.slow(reason="hundreds of thousands of wire frames take some minutes")
@pytest.mark.timeout(3000)
def test_many_frames(line, figure: Callable[[str, str], None]):
    """A million of them with ``make firmware-figures``."""
    n = 1_000_000 if "FIRMWARE_FIGURES" in os.environ else 200_000
    speech = told(line, n)
    figure(
        f"{n:,} wire frames to a module with the compiler's checks of memory and arithmetic, posix",
        f"damaged in {speech.n_damaged} places; {line.n_answers} answers, each as the emulator's, "
        "none where none was due; no fault",
    )
