"""Rules of what a module sends on its own. All look at the same few seconds of listening."""

from __future__ import annotations

import math
import statistics
from collections import Counter

from devices.conformance.bench import ArrivedPacket, Bench, steps
from devices.conformance.rule import BrokenError, SkippedError, demand, rule
from devices.link import Framing
from firmware_protocol import DeviceInfo, Health, InertialSample, InertialSampleFine
from firmware_protocol.commands import Verb, decode_payload
from firmware_protocol.device_settings import decode_value
from firmware_protocol.messages import DEVICE_INFO_INTERVAL_S

LISTENED_S = 2 * DEVICE_INFO_INTERVAL_S + 1.5
"""Two intervals of what comes most rarely."""

_SEQUENCES = 2**16
_STAMPS = 2**32
_RATE_TOLERANCE = 0.02
_CLOCK_TOLERANCE = 0.02
_UNEVEN = 0.25
"""Of an interval: half of the samples are no farther from even than this."""
_GRAVITY = (7.0, 13.0)
_SAMPLING_RATE, _MODE = 2, 8


def samples(bench: Bench, since: int = 0) -> list[ArrivedPacket]:
    """Return the module's inertial samples since a mark."""
    return [
        each
        for each in bench.packets[since:]
        if isinstance(each.packet, InertialSample | InertialSampleFine)
        and each.received.module == bench.module
    ]


def _some(bench: Bench) -> list[ArrivedPacket]:
    found = samples(bench)
    if len(found) < 10:
        raise BrokenError(f"{len(found)} samples came in {LISTENED_S:.0f} s")
    return found


async def setting(bench: Bench, key: int) -> object:
    """Return the value of a setting of the module. Raises ``SkippedError`` where it does not answer."""
    answer = await bench.request(Verb.READ_SETTING, key)
    payload = None if answer is None else decode_payload(Verb.READ_SETTING, answer.payload)
    if payload is None or payload[0] != key:
        raise SkippedError("READ_SETTING does not tell what the module was set to")
    return decode_value(key, payload[1])


async def needs_own_timer(bench: Bench) -> None:
    """Raise ``SkippedError`` for a module that samples on triggers or fuses on board."""
    if await setting(bench, _MODE) != 2:
        raise SkippedError("the module is not set to raw samples on its own timer (mode 2)")


@rule("frames_whole", "every wire frame is stuffed, checked and of the length that its kind demands")
async def frames_whole(bench: Bench) -> None:
    """Look at what was dropped; a line that was opened within a wire frame gives one that is broken."""
    dropped = Counter(bench.decoder.dropped)
    allowed = 1 if bench.link.framing is Framing.BYTE_STREAM else 2
    counts = ", ".join(f"{count} {defect.name}" for defect, count in dropped.items())
    demand(dropped.total() <= allowed, f"dropped: {counts}")


@rule("device_info", "DeviceInfo every 5 s")
async def device_info(bench: Bench) -> None:
    """Look for two that are 5 s apart, and for one unique id under the module's number."""
    infos = bench.from_module(DeviceInfo)
    own = {each.packet.unique_id for each in infos}
    demand(own == {bench.unique_id}, f"under id {bench.module} came {len(own)} unique ids")
    demand(bench.unique_id != bytes(12), "the unique id is all zeros, which means everybody")
    stamps = [each.received.module_time_us for each in infos]
    on_time = [s for s in steps(stamps, _STAMPS) if abs(s * 1e-6 - DEVICE_INFO_INTERVAL_S) < 0.5]
    demand(
        on_time, f"{len(infos)} came in {LISTENED_S:.0f} s, no two of them 5 s apart by the module's stamps"
    )


@rule("health", "Health every second; uptime and samples count upwards")
async def health(bench: Bench) -> None:
    """Hold the first and the last against each other, and against what came between them."""
    found = bench.from_module(Health)
    demand(len(found) >= LISTENED_S * 0.7, f"{len(found)} came in {LISTENED_S:.0f} s")
    first, last = found[0], found[-1]
    passed_s = (last.received.module_time_us - first.received.module_time_us) % _STAMPS * 1e-6
    counted_s = last.packet.uptime_s - first.packet.uptime_s
    demand(abs(counted_s - passed_s) <= 1.5, f"uptime grew by {counted_s} s in {passed_s:.1f} s of its clock")
    taken = last.packet.samples_taken - first.packet.samples_taken
    seen = len([s for s in samples(bench) if first.arrived_ns < s.arrived_ns <= last.arrived_ns])
    # Samples are counted where they are taken and where they arrive: 20 may be on their way.
    demand(taken + 20 >= 0.98 * seen, f"samples_taken grew by {taken} while {seen} samples came")


@rule("sequence_of_samples", "sequence goes up by one for every sample, and counts each kind by itself")
async def sequence_of_samples(bench: Bench) -> None:
    """Look at the commonest step; samples that the module or a busy host lost leave larger ones."""
    await needs_own_timer(bench)
    found = Counter(steps([each.received.sequence for each in _some(bench)], _SEQUENCES))
    common, count = found.most_common(1)[0]
    demand(common == 1, f"the commonest step of sequence is {common} ({count} of {found.total()})")
    demand(
        count >= 0.9 * found.total(),
        f"{found.total() - count} of {found.total()} steps are not one: {dict(found)}",
    )


@rule("sequence_of_reports", "sequence goes up by one for every packet of its kind: DeviceInfo, Health")
async def sequence_of_reports(bench: Bench) -> None:
    """Look at every step; one report may be lost."""
    for kind in (DeviceInfo, Health):
        found = list(steps([each.received.sequence for each in bench.from_module(kind)], _SEQUENCES))
        demand(found and set(found) <= {1, 2}, f"{kind.__name__}: steps of sequence are {found}")


@rule("stamps_rise", "module_time_us is the instant of sampling, by a free-running counter of microseconds")
async def stamps_rise(bench: Bench) -> None:
    """Look at every step, through the wrap of the counter."""
    found = list(steps([each.received.module_time_us for each in _some(bench)], _STAMPS))
    backwards = sum(step == 0 or step > _STAMPS // 2 for step in found)
    demand(not backwards, f"{backwards} of {len(found)} stamps are not later than the one before")


@rule("counter_in_microseconds", "the timer runs at a nominal 1 MHz")
async def counter_in_microseconds(bench: Bench) -> None:
    """Hold the counter against the host's clock: between the first quarter of the samples and the last."""
    passed_us, drift = _passed_and_drift(_some(bench))
    demand(
        abs(drift) < _CLOCK_TOLERANCE,
        f"while the host's clock went on by {(1 + drift) * passed_us * 1e-6:.2f} "
        f"s, the counter went on by {passed_us} "
        "(µs?): the prescaler of the timer is off",
    )


def _passed_and_drift(found: list[ArrivedPacket]) -> tuple[int, float]:
    """Return by how much the counter went on, and how much more the host's clock did, as a share of that."""
    part = len(found) // 4
    stamps = [0]
    for step in steps([each.received.module_time_us for each in found], _STAMPS):
        stamps.append(stamps[-1] + step)
    # What came with the least delay, early and late: a busy host makes packets late and never early.
    lags = [each.arrived_ns - stamp * 1000 for each, stamp in zip(found, stamps, strict=True)]
    passed_us = stamps[-1 - part // 2] - stamps[part // 2]
    return passed_us, (min(lags[-part:]) - min(lags[:part])) * 1e-3 / max(passed_us, 1)


@rule("even_sampling", "samples are even in time, and as many as sampling_rate says")
async def even_sampling(bench: Bench) -> None:
    """Look at the median interval, and how far half of them are from it: samples may be missing."""
    await needs_own_timer(bench)
    rate = await setting(bench, _SAMPLING_RATE)
    assert isinstance(rate, float)
    found = _some(bench)
    numbered = zip(
        steps([each.received.sequence for each in found], _SEQUENCES),
        steps([each.received.module_time_us for each in found], _STAMPS),
        strict=True,
    )
    # Per step of the sequence number: lost samples must not look like long intervals.
    intervals = [step_us / max(step, 1) for step, step_us in numbered if step < 1000]
    median = statistics.median(intervals)
    demand(
        abs(median * rate * 1e-6 - 1) < _RATE_TOLERANCE,
        f"half of the samples are {median:.0f} µs apart, where {rate:g} Hz are {1e6 / rate:.0f} µs",
    )
    off = statistics.median(abs(each - median) for each in intervals)
    demand(off < _UNEVEN * median, f"half of the intervals are {off:.0f} µs off from {median:.0f} µs")


@rule("specific_force", "specific force in its steps: at rest 9.81 m/s² whichever way the module lies")
async def specific_force(bench: Bench) -> None:
    """Look at the median norm, wide enough for a module that is worn and not laid down."""
    forces = [each.packet.specific_force for each in _some(bench) if each.packet.specific_force is not None]
    if not forces:
        raise SkippedError("the module has no accelerometer")
    norm = statistics.median(math.hypot(*force) for force in forces)
    low, high = _GRAVITY
    demand(
        low < norm < high,
        f"half of the samples read {norm:.2f} m/s² and more: wrong steps, or gravity removed",
    )


@rule("sensors_reported", "DeviceInfo tells range and rate of each sensor that samples have, and of no other")
async def sensors_reported(bench: Bench) -> None:
    """Hold the newest DeviceInfo against all samples."""
    info = bench.from_module(DeviceInfo)[-1].packet
    for sensor, stated_range in (
        ("specific_force", info.accelerometer_range),
        ("angular_rate", info.gyroscope_range),
        ("magnetic_field", info.magnetometer_range),
    ):
        is_sent = any(getattr(each.packet, sensor) is not None for each in _some(bench))
        demand(
            is_sent == (stated_range is not None),
            f"{sensor}: {'sent' if is_sent else 'not sent'}, range stated_range: {stated_range}",
        )


STREAMING = (
    frames_whole,
    device_info,
    health,
    sequence_of_samples,
    sequence_of_reports,
    stamps_rise,
    counter_in_microseconds,
    even_sampling,
    specific_force,
    sensors_reported,
)
