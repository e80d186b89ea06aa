"""Rules of what a module keeps. They change settings; what stood there before is put back in the end."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from statistics import median

from devices.commands.setting_values import SETTING_KEYS, encoded_setting
from devices.conformance.bench import PATIENCE_S, Bench, steps
from devices.conformance.commanding import UNKNOWN_KEY, demand_result
from devices.conformance.rule import BrokenError, SkippedError, demand, rule
from devices.conformance.streaming import needs_own_timer, samples
from firmware_protocol import MAX_MODULE, Event, SamplingTrigger
from firmware_protocol.commands import Result, Verb, decode_payload
from firmware_protocol.device_settings import SETTINGS

SETTINGS_COMMITTED = 7
_LABEL, _OTHER_LABEL = "conformance", "otherwise"
_TRIGGERS = (7, 8, 8, 65535, 0)
_QUIET_S = 0.4


async def held(bench: Bench, name: str) -> bytes | None:
    """Return the bytes of a setting; None where it is not answered."""
    answer = await bench.request(Verb.READ_SETTING, SETTING_KEYS[name])
    payload = None if answer is None else decode_payload(Verb.READ_SETTING, answer.payload)
    return None if payload is None else bytes(payload[1])


async def backup(bench: Bench) -> dict[str, bytes]:
    """Return all settings by name."""
    found = {name: await held(bench, name) for name in SETTING_KEYS}
    return {name: raw for name, raw in found.items() if raw is not None}


async def write(bench: Bench, wanted: Mapping[str, bytes]) -> None:
    """Stage and commit; what the module refuses is left out."""
    for name, raw in wanted.items():
        await bench.request(Verb.WRITE_SETTING, SETTING_KEYS[name], raw)
    await bench.request(Verb.COMMIT)


async def _stage(bench: Bench, name: str, value: object) -> None:
    answer = await bench.request(Verb.WRITE_SETTING, SETTING_KEYS[name], encoded_setting(name, value))
    if answer is not None and answer.result == Result.REFUSED:
        raise SkippedError("writes are locked on the module")
    demand_result(answer, Result.DONE, f"WRITE_SETTING {name}={value}")


async def _commit(bench: Bench) -> int:
    answer = await bench.request(Verb.COMMIT)
    demand_result(answer, Result.DONE, "COMMIT")
    payload = decode_payload(Verb.COMMIT, answer.payload if answer else b"")
    if payload is None:
        raise BrokenError("the answer to COMMIT does not hold the generation")
    return int(payload[0])


_BEYOND = {
    "module_id": bytes([MAX_MODULE + 1]),
    "sampling_rate": bytes(2),
    "mode": bytes([0]),
    "label": b"\xff" * 16,
    "calibration": b"\xff" * SETTINGS[SETTING_KEYS["calibration"]].value.size,
}
"""Bytes of settings that no module may take: too large, zero, no text, no numbers."""


@rule("staged", "WRITE_SETTING stages a value, which is read back; DISCARD forgets it", is_writing=True)
async def staged(bench: Bench) -> None:
    """Stage a label, read it, discard it, and read again."""
    before = await held(bench, "label")
    await _stage(bench, "label", _LABEL)
    demand(
        await held(bench, "label") == encoded_setting("label", _LABEL), "what was staged does not read back"
    )
    demand_result(await bench.request(Verb.DISCARD), Result.DONE, "DISCARD")
    demand(await held(bench, "label") == before, "DISCARD did not forget what was staged")


@rule("nothing_staged", "COMMIT with nothing staged is answered with result 8", is_writing=True)
async def nothing_staged(bench: Bench) -> None:
    """Discard whatever is staged before."""
    await bench.request(Verb.DISCARD)
    demand_result(await bench.request(Verb.COMMIT), Result.NOTHING_STAGED, "COMMIT")


@rule(
    "limits",
    "a value outside the limits is refused with result 2, a key that there is not with 6",
    is_writing=True,
)
async def limits(bench: Bench) -> None:
    """Write values beyond the limits, and look that none of them was staged."""
    for name, raw in _BEYOND.items():
        before = await held(bench, name)
        if before is None:
            continue
        answer = await bench.request(Verb.WRITE_SETTING, SETTING_KEYS[name], raw)
        demand_result(answer, Result.BAD_ARGUMENTS, f"WRITE_SETTING {name}={raw[:4].hex()}")
        demand(await held(bench, name) == before, f"a value of {name} that was refused reads back")
    answer = await bench.request(Verb.WRITE_SETTING, UNKNOWN_KEY, b"\x01")
    demand_result(answer, Result.NO_SUCH_SETTING, f"WRITE_SETTING {UNKNOWN_KEY}")


@rule(
    "commit", "COMMIT stores what is staged, counts the generation up, and Event 7 follows", is_writing=True
)
async def commit(bench: Bench) -> None:
    """Commit two labels one after the other."""
    generations = []
    for label in (_LABEL, _OTHER_LABEL):
        await _stage(bench, "label", label)
        since = bench.mark()
        generations.append(await _commit(bench))
        demand(
            await held(bench, "label") == encoded_setting("label", label),
            "what was committed does not read back",
        )

        def was_reported(since: int = since) -> bool:
            return any(each.packet.event == SETTINGS_COMMITTED for each in bench.from_module(Event, since))

        demand(await bench.until(was_reported), "no Event 7 came")
    demand(
        (generations[1] - generations[0]) % 2**32 == 1, f"the generations of two commits are {generations}"
    )


@rule("acts_by_settings", "COMMIT: the module acts by the new settings, here sampling_rate", is_writing=True)
async def acts_by_settings(bench: Bench) -> None:
    """Set 25 Hz, and look at the median interval: a module that missed some samples has the right rate."""
    await needs_own_timer(bench)
    before = await held(bench, "sampling_rate")
    try:
        await _stage(bench, "sampling_rate", 25.0)
        await asyncio.sleep(_QUIET_S)
        await _commit(bench)
        since = bench.mark()
        came = await bench.until(lambda: len(samples(bench, since)) >= 26, 2 * PATIENCE_S)
        demand(came, "too few samples at 25 Hz")
        # The first sample may still be of the old rate.
        found = [each.received.module_time_us for each in samples(bench, since)][1:26]
        interval_s = median(steps(found, 2**32)) * 1e-6
        demand(
            0.038 < interval_s < 0.042,
            f"samples at 25 Hz are {interval_s:.3f} s apart by the module's clock",
        )
    finally:
        await bench.request(Verb.DISCARD)
        if before is not None:
            await write(bench, {"sampling_rate": before})


@rule("takes_id", "after COMMIT of module_id the module sends under it", is_writing=True)
async def takes_id(bench: Bench) -> None:
    """Give it another id, and ask under which it answers."""
    before = await held(bench, "module_id")
    if before is None or bench.module > MAX_MODULE:
        raise SkippedError("the device has no module_id")
    other = (bench.module + 7) % (MAX_MODULE + 1)
    try:
        await _stage(bench, "module_id", other)
        demand(bench.module != other, "the new id is used before COMMIT")
        await _commit(bench)
        answer = await bench.request(Verb.HELLO, 1, 1)
        demand(
            answer is not None and bench.module == other, f"it answers under id {bench.module}, not {other}"
        )
    finally:
        await bench.request(Verb.DISCARD)
        await write(bench, {"module_id": before})


@rule(
    "factory_reset",
    "FACTORY_RESET commits the factory values, and obeys its one magic alone",
    is_writing=True,
)
async def factory_reset(bench: Bench) -> None:
    """Reset it with a wrong magic, which is refused, and with the right one."""
    kept = await backup(bench)
    await _stage(bench, "label", _LABEL)
    await _commit(bench)
    answer = await bench.request(
        Verb.FACTORY_RESET, arguments=b"FACT"
    )  # the right letters, the wrong way round
    demand_result(answer, Result.BAD_ARGUMENTS, "FACTORY_RESET with a wrong magic")
    demand(await held(bench, "label") == encoded_setting("label", _LABEL), "a wrong magic reset the module")
    try:
        demand_result(await bench.request(Verb.FACTORY_RESET, 0x46414354), Result.DONE, "FACTORY_RESET")
        reads = await held(bench, "label")
        demand(
            reads == encoded_setting("label", SETTINGS[SETTING_KEYS["label"]].factory),
            f"the label is {reads!r}",
        )
    finally:
        await write(bench, kept)


@rule(
    "triggers",
    "in mode 3 a sample for each trigger, under its number, marked; "
    "a trigger that comes twice is obeyed once",
    is_writing=True,
)
async def triggers(bench: Bench) -> None:
    """Set mode 3, and trigger another module, then this one, across the wrap and once twice."""
    before = await held(bench, "mode")
    answer = await bench.request(Verb.WRITE_SETTING, SETTING_KEYS["mode"], bytes([3]))
    if answer is not None and answer.result == Result.NOT_SUPPORTED:
        raise SkippedError("the module has no mode 3")
    demand_result(answer, Result.DONE, "WRITE_SETTING mode=3")
    try:
        await _commit(bench)
        await asyncio.sleep(_QUIET_S)
        await _demand_samples_on_triggers(bench)
    finally:
        await bench.request(Verb.DISCARD)
        if before is not None:
            await write(bench, {"mode": before})


async def _demand_samples_on_triggers(bench: Bench) -> None:
    """Raise ``BrokenError`` unless a module in mode 3 samples on its triggers alone, once on each."""
    since = bench.mark()
    await bench.send(SamplingTrigger(3), (bench.module + 1) % (MAX_MODULE + 1))
    await asyncio.sleep(_QUIET_S)
    demand(not samples(bench, since), "samples came without a trigger, or on one to another module")
    for number in _TRIGGERS:
        await bench.send(SamplingTrigger(number), bench.module)
        await asyncio.sleep(0.05)
    # A number that comes twice is the same trigger repeated, and wants one sample.
    wanted = list(dict.fromkeys(_TRIGGERS))
    await bench.until(lambda: len(samples(bench, since)) >= len(wanted))
    await asyncio.sleep(_QUIET_S)
    found = samples(bench, since)
    numbers = [each.received.sequence for each in found]
    demand(numbers == wanted, f"triggers {list(_TRIGGERS)} gave samples {numbers}")
    demand(all(each.packet.triggered for each in found), "samples are not marked as triggered")


WRITING = (
    staged,
    nothing_staged,
    limits,
    commit,
    acts_by_settings,
    takes_id,
    factory_reset,
    triggers,
)
