"""Faults of what is around the gateway: broker, network, disk, clock. See ``benchmarks.faults``."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from benchmarks.broker_proxy import BrokerProxy
from benchmarks.fault_bench import BROKER_LIMIT_S, WHOLE_LIMIT_S, Bench, Broker, Outcome
from devices.emulators.faults.fault_plan import FaultPlan
from gateway.outputs.mqtt import MqttOutput

BEGIN_S = 4.0
WATCHED_S = 2.0
DISK_MB = 4
LONGEST_WAIT_S = 15.0


class _Set(NamedTuple):
    """What a fault of the surroundings can get at."""

    bench: Bench
    broker: Broker
    proxy: BrokerProxy

    @property
    def mqtt(self) -> MqttOutput:
        return self.bench.service.mqtt


@contextlib.asynccontextmanager
async def _running(folder: Path | None = None) -> AsyncIterator[_Set]:
    """A gateway that has settled, its broker behind a network that can be spoilt."""
    with tempfile.TemporaryDirectory() as own, Broker() as broker:
        async with (
            BrokerProxy(broker.port) as proxy,
            Bench(proxy.port, FaultPlan(), Path(own), recordings=folder) as bench,
        ):
            await bench.until(BEGIN_S)
            bench.begin()
            yield _Set(bench, broker, proxy)


async def _until(is_so: Callable[[], bool]) -> float:
    """Seconds until something is so; infinite when it takes too long."""
    begun = time.monotonic()
    while not is_so():
        if time.monotonic() - begun > LONGEST_WAIT_S:
            return float("inf")
        await asyncio.sleep(0.005)
    return time.monotonic() - begun


async def _pose_out(mqtt: MqttOutput) -> float:
    """Seconds until the next pose is published."""
    published = mqtt.counters.published
    return await _until(lambda: mqtt.counters.published > published)


async def broker_slow() -> Outcome:
    """The network takes a tenth of what is sent, for three seconds."""
    async with _running() as there:
        there.proxy.bytes_per_s = 20_000.0
        await asyncio.sleep(3.0)
        there.proxy.bytes_per_s = None
        recovery_s = await _pose_out(there.mqtt)
        return there.bench.outcome("broker slow: 20 kB/s for 3 s", recovery_s, BROKER_LIMIT_S)


async def broker_frozen() -> Outcome:
    """The broker's process is stopped for three seconds."""
    async with _running() as there:
        there.broker.freeze()
        await asyncio.sleep(3.0)
        there.broker.thaw()
        recovery_s = await _pose_out(there.mqtt)
        return there.bench.outcome("broker frozen for 3 s", recovery_s, BROKER_LIMIT_S)


async def broker_away() -> Outcome:
    """Killed, and started again five seconds later."""
    async with _running() as there:
        there.broker.kill()
        await asyncio.sleep(5.0)
        await asyncio.to_thread(there.broker.start)
        recovery_s = await _pose_out(there.mqtt)
        return there.bench.outcome("broker killed, back after 5 s", recovery_s, BROKER_LIMIT_S)


async def broker_refuses() -> Outcome:
    """Back from a restart it knows nobody any more, for three seconds."""
    async with _running() as there:
        there.broker.kill()
        await asyncio.to_thread(there.broker.start, is_open=False)
        await asyncio.sleep(3.0)
        there.broker.kill()
        await asyncio.to_thread(there.broker.start)
        recovery_s = await _pose_out(there.mqtt)
        return there.bench.outcome("broker refuses the login for 3 s", recovery_s, BROKER_LIMIT_S)


async def network_cut() -> Outcome:
    """Nothing passes between gateway and broker for five seconds, and nobody is told."""
    async with _running() as there:
        there.proxy.is_cut = True
        await asyncio.sleep(5.0)
        there.proxy.is_cut = False
        recovery_s = await _pose_out(there.mqtt)
        return there.bench.outcome("network to the broker cut for 5 s", recovery_s, BROKER_LIMIT_S)


async def disk_full() -> Outcome:
    """The recording fills its disk; poses go on, and a new recording begins once there is room."""
    with _small_disk() as disk:
        if disk is None:
            return Outcome.not_done("disk full", "only root may mount a small disk")
        async with _running(disk) as there:
            control = there.bench.service.recording
            control.start("filling")
            (disk / "filler").write_bytes(b"x" * round((DISK_MB - 0.5) * 1e6))
            await _until(lambda: not control.is_recording)
            await asyncio.sleep(1.0)
            since_ns = there.bench.now_ns
            (disk / "filler").unlink()
            await asyncio.sleep(WATCHED_S)
            recovery_s = there.bench.watch.recovered_s(since_ns)
            outcome = there.bench.outcome("disk full while recording", recovery_s, WHOLE_LIMIT_S)
            control.start("again")  # raises if it may not
            return outcome


@contextlib.contextmanager
def _small_disk() -> Iterator[Path | None]:
    """A disk of ``DISK_MB`` in memory; None where it may not be mounted."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", folder]
        if os.geteuid() != 0 or subprocess.run(command, check=False, capture_output=True).returncode:
            yield None
            return
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "-l", folder], check=True)


async def clock_set() -> Outcome:
    """The host's wall clock is set an hour forward: gateway time must not notice."""
    async with _running() as there:
        observer = there.bench.service.observer
        observer._utc_ns = lambda: time.time_ns() + 3_600_000_000_000
        since_ns = there.bench.now_ns
        await asyncio.sleep(WATCHED_S)
        steps = 0 if observer.utc is None else observer.utc.steps
        recovery_s = there.bench.watch.recovered_s(since_ns) if steps == 1 else float("inf")
        return there.bench.outcome("wall clock set by +1 h", recovery_s, WHOLE_LIMIT_S)


SURROUNDINGS = (broker_slow, broker_frozen, broker_away, broker_refuses, network_cut, disk_full, clock_set)
"""All of them, in the order of the table."""
