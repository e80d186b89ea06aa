"""Machine code whose clock counts instructions: sleep takes no time, and instants can be told beforehand."""

from __future__ import annotations

import contextlib
import random
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from devices.emulators.device.firmware_memory import FirmwareMemory
from devices.free_ports import free_port
from devices.link import Chunk
from firmware_protocol import FrameDecoder, InertialSample, PacketDecoder
from gateway.frames import InertialBatch
from gateway.sources.suit import SuitSource
from tests.firmware.machines import QEMU, command_of
from tests.patience import PATIENCE_S

pytestmark = [pytest.mark.system]

JITTER_US = 3
"""A sample may be taken so much after its instant: another interrupt is under way, or the processor wakes."""
SECOND_NS = 1_000_000_000
FAST = 37e-6
"""By how much the gateway's clock is faster than the module's."""


@contextlib.contextmanager
def frames_of(program: Path, memory: FirmwareMemory) -> Iterator[Iterator[bytes]]:
    """Run a module as fast as it goes; give its wire frames, with the byte that ends each."""
    port = free_port()
    line = ["-serial", f"tcp:127.0.0.1:{port},server=on,wait=on", "-icount", "shift=5,sleep=off"]
    process = subprocess.Popen(command_of(program, memory, *line), stderr=subprocess.DEVNULL)
    try:
        with connected(port, process) as connection:
            yield split(connection)
    finally:
        process.kill()
        process.wait()


def connected(port: int, process: subprocess.Popen[bytes]) -> socket.socket:
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        except ConnectionRefusedError:
            assert process.poll() is None, "QEMU ended"
            assert time.monotonic() < end, "QEMU does not listen"
            time.sleep(0.01)


def split(connection: socket.socket) -> Iterator[bytes]:
    rest = b""
    while data := connection.recv(65536):
        *whole, rest = (rest + data).split(b"\0")
        yield from (each + b"\0" for each in whole if each)


def samples_of(frames: Iterator[bytes]) -> Iterator[tuple[int, int, bytes]]:
    """Yield number and stamp, µs since the first, of each sample through all wraps, and its frame."""
    decoder = PacketDecoder(FrameDecoder())
    number, stamp_us, first_us = -1, 0, None
    for frame in frames:
        for received in decoder.feed(frame):
            if isinstance(received.packet, InertialSample):
                if first_us is None:
                    first_us = stamp_us = received.module_time_us
                    number = received.sequence
                number += (received.sequence - number) % 2**16
                stamp_us += (received.module_time_us - stamp_us) % 2**32
                yield number, stamp_us - first_us, frame


def late_us(stamp_us: int, k: int, rate_hz: float) -> float:
    return stamp_us - k * 1e6 / rate_hz


@pytest.mark.parametrize("rate_hz", [30.0, 100.0, 200.0])
def test_samples_are_stamped_within_microseconds_of_their_instants(
    program_of: Callable[[str], Path], tmp_path: Path, rate_hz: float, figure: Callable[[str, str], None]
) -> None:
    settings = {"module_id": 1, "sampling_rate": rate_hz}
    memory = FirmwareMemory.fresh(tmp_path / "m.img", bytes(12), settings=settings)
    with frames_of(program_of(QEMU), memory) as frames:
        told = [next(samples) for samples in [samples_of(frames)] for _ in range(2000)]
    assert [number - told[0][0] for number, _, _ in told] == list(range(2000))
    late = np.array([late_us(stamp_us, k, rate_hz) for k, (_, stamp_us, _) in enumerate(told)])
    late -= late.min()
    figure(
        f"Stamps of 2000 samples against the instants of their interrupts, {rate_hz:g} Hz, {QEMU}",
        f"at most {late.max():.1f} µs later, standard deviation {late.std():.2f} µs",
    )
    assert late.max() <= JITTER_US


@pytest.mark.slow(reason="two hours of the module's time take some minutes of this computer's")
@pytest.mark.timeout(3600)
def test_two_hours_on_a_clock_that_wraps(
    program_of: Callable[[str], Path], tmp_path: Path, figure: Callable[[str, str], None]
) -> None:
    rate_hz, n, rng = 100.0, 720_000, random.Random(28)
    memory = FirmwareMemory.fresh(tmp_path / "m.img", bytes(12), settings={"module_id": 1})
    stream, errors_us = SuitSource(), []
    stream.add_link("module", "byte_stream")
    latest = earliest = 0.0
    first = None
    with frames_of(program_of(QEMU), memory) as frames:
        for k, (number, stamp_us, frame) in enumerate(samples_of(frames)):
            first = number if first is None else first
            assert number == first + k
            late = late_us(stamp_us, k, rate_hz)
            earliest, latest = min(earliest, late), max(latest, late)
            at_ns = SECOND_NS + stamp_us * 1e3 * (1 + FAST)
            arrived_ns = round(at_ns + rng.expovariate(1e-6))  # some 1 ms later
            for batch in stream.receive(Chunk(frame, arrived_ns, "module")):
                if isinstance(batch, InertialBatch) and k > 6000:
                    errors_us += [(int(sample["time_ns"]) - at_ns) * 1e-3 for sample in batch.samples]
            if k == n:
                break
    assert stamp_us > 2**32
    assert latest - earliest <= JITTER_US
    off = np.array(errors_us)
    (record,) = stream.modules.values()
    figure(
        f"Two hours of the module's time, {k} samples, one wrap of its counter, {QEMU}",
        f"stamps within {latest - earliest:.1f} µs; a gateway whose clock is {FAST * 1e6:.0f} ppm faster, "
        f"and which receives samples 1 ms late on average, dates them {off.mean():+.0f} ± {off.std():.0f} µs "
        f"off and finds {record.clock.figures().skew_ppm:+.2f} ppm",
    )
    assert np.abs(off).max() < 1000
    assert record.clock.restarts == 0
    assert record.clock.figures().skew_ppm == pytest.approx(-1e6 * FAST, abs=1.0)
