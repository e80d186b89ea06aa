"""Rules of commands that change nothing that is kept."""

from __future__ import annotations

import asyncio

from devices.commands.command_client import host_bytes
from devices.conformance.bench import PATIENCE_S, Bench
from devices.conformance.rule import SkippedError, demand, rule
from devices.conformance.streaming import needs_own_timer, samples
from devices.link import Framing
from firmware_protocol import DeviceInfo, Health
from firmware_protocol.commands import (
    ANSWER_MEMORY,
    BROADCAST_ANSWER_DELAY_US,
    Result,
    Verb,
    decode_payload,
    encode_arguments,
)
from firmware_protocol.device_settings import SETTINGS, decode_value
from firmware_protocol.framing import BROADCAST, MAX_MODULE, SUPPORTED
from firmware_protocol.messages import Acknowledgement, Command

UNKNOWN_VERB, UNKNOWN_KEY = 200, 199
_WRONG_ID = bytes(range(100, 112))
_OVERLONG = 5000
_STOPPED_S = 0.6


def result_of(answer: Acknowledgement | None) -> str:
    """Return in words how a command ended."""
    if answer is None:
        return "no answer came"
    known = {int(each): each.name for each in Result}
    return f"result {answer.result} ({known.get(answer.result, 'which there is not')})"


async def demand_silence(bench: Bench, transaction: int, since: int, what: str) -> None:
    """Raise ``BrokenError`` unless a command is not answered, while one that comes after it is."""
    demand(await bench.is_answering(), f"after {what} no other command is answered any more")
    demand(not bench.answers(transaction, since), f"{what} was answered")


def demand_result(answer: Acknowledgement | None, wanted: Result, what: str) -> None:
    """Raise ``BrokenError`` unless a command ended so."""
    demand(answer is not None and answer.result == wanted, f"{what}: {result_of(answer)}, not {int(wanted)}")


@rule("hello", "HELLO is answered with the highest version that both know")
async def hello(bench: Bench) -> None:
    """Ask with the versions that this host speaks."""
    answer = await bench.request(Verb.HELLO, *SUPPORTED)
    demand_result(answer, Result.DONE, "HELLO")
    payload = decode_payload(Verb.HELLO, answer.payload if answer else b"")
    demand(
        payload is not None and payload[0] == SUPPORTED[1], f"versions {SUPPORTED} were answered by {payload}"
    )


@rule("hello_no_version", "HELLO with versions that the device does not know is answered with 0")
async def hello_no_version(bench: Bench) -> None:
    """Ask with versions that do not exist yet."""
    answer = await bench.request(Verb.HELLO, 200, 201)
    demand_result(answer, Result.DONE, "HELLO 200 to 201")
    payload = decode_payload(Verb.HELLO, answer.payload if answer else b"")
    demand(payload is not None and payload[0] == 0, f"versions 200 to 201 were answered by {payload}")


@rule("identify", "IDENTIFY is answered, and so is 0, which stops it")
async def identify(bench: Bench) -> None:
    """Have it blink for a second, and stop; whether it does cannot be seen from the line."""
    for seconds in (1, 0):
        demand_result(await bench.request(Verb.IDENTIFY, seconds), Result.DONE, f"IDENTIFY {seconds} s")


@rule("get_info", "GET_INFO is answered, then DeviceInfo and Health are sent")
async def get_info(bench: Bench) -> None:
    """Ask once for each of both, in less time than they take to come by themselves."""
    for kind in (DeviceInfo, Health):
        since = bench.mark()
        demand_result(await bench.request(Verb.GET_INFO), Result.DONE, "GET_INFO")

        def followed(kind: type[DeviceInfo | Health] = kind, since: int = since) -> bool:
            return bool(bench.from_module(kind, since))

        came = await bench.until(followed, 0.8)
        demand(came, f"no {kind.__name__} followed within 0.8 s")


@rule("unknown_verb", "a verb that the device does not know is answered with result 1, never with silence")
async def unknown_verb(bench: Bench) -> None:
    """Ask with a verb that does not exist yet."""
    demand_result(
        await bench.request(UNKNOWN_VERB, arguments=b""), Result.UNKNOWN_VERB, f"verb {UNKNOWN_VERB}"
    )


@rule("card_verbs", "what the device does not have is answered with result 9, never with silence")
async def card_verbs(bench: Bench) -> None:
    """Ask for the files of a card, which most modules do not have."""
    answer = await bench.request(Verb.CARD_LIST, 0)
    demand(
        answer is not None and answer.result in (Result.DONE, Result.NOT_SUPPORTED),
        f"CARD_LIST: {result_of(answer)}",
    )


@rule("bad_arguments", "arguments of another length than declared are answered with result 2")
async def bad_arguments(bench: Bench) -> None:
    """Ask with too few and with too many bytes."""
    for verb, arguments in ((Verb.HELLO, b"\x01"), (Verb.IDENTIFY, b""), (Verb.READ_SETTING, b"\x01\x02")):
        answer = await bench.request(verb, arguments=arguments)
        demand_result(answer, Result.BAD_ARGUMENTS, f"{verb.name} with {len(arguments)} bytes")


@rule(
    "read_settings",
    "READ_SETTING gives every setting, within its limits; result 6 for a key that there is not",
)
async def read_settings(bench: Bench) -> None:
    """Read all that are declared, of which a firmware need not have every one, and one that is not."""
    for key, declared in SETTINGS.items():
        answer = await bench.request(Verb.READ_SETTING, key)
        if answer is not None and answer.result == Result.NO_SUCH_SETTING:
            continue  # a firmware need not have them all
        demand_result(answer, Result.DONE, f"READ_SETTING {declared.name}")
        payload = decode_payload(Verb.READ_SETTING, answer.payload if answer else b"")
        value = None if payload is None or payload[0] != key else decode_value(key, payload[1])
        demand(
            value is not None, f"READ_SETTING {declared.name} gives {answer.payload.hex() if answer else ''}"
        )
    answer = await bench.request(Verb.READ_SETTING, UNKNOWN_KEY)
    demand_result(answer, Result.NO_SUCH_SETTING, f"READ_SETTING {UNKNOWN_KEY}")


@rule("stop_and_start", "STOP ends sampling, START begins it; both come twice without harm")
async def stop_and_start(bench: Bench) -> None:
    """Give each twice, and look for samples in between and afterwards."""
    await needs_own_timer(bench)
    try:
        for _ in range(2):
            demand_result(await bench.request(Verb.STOP), Result.DONE, "STOP")
        await asyncio.sleep(_STOPPED_S)
        since = bench.mark()
        await asyncio.sleep(_STOPPED_S)
        demand(not samples(bench, since), f"{len(samples(bench, since))} samples came after STOP")
    finally:
        # Also where the rule is broken: the module is left sending, as it was found.
        started = [await bench.request(Verb.START) for _ in range(2)]
    demand(all(each is not None and each.result == Result.DONE for each in started), "START is not answered")
    demand(await bench.until(lambda: len(samples(bench, since)) > 1), "no samples came after START")


@rule("repeated_command", "a command that comes again is answered as before, and not carried out again")
async def repeated_command(bench: Bench) -> None:
    """Stop it, start it, and send the same STOP again after as many others as are to be remembered."""
    await needs_own_timer(bench)
    stop = bench.next_transaction()
    try:
        first = await _answer_to_stop(bench, stop)
        demand(first is not None, "STOP is not answered")
    # The module must sample again, whatever the test finds.
    finally:
        await bench.request(Verb.START)
    # Just as many other commands as it has to remember beside the first.
    for _ in range(ANSWER_MEMORY - 2):
        await bench.request(Verb.HELLO, *SUPPORTED)
    again = await _answer_to_stop(bench, stop)
    await asyncio.sleep(_STOPPED_S)
    since = bench.mark()
    is_sampling = await bench.until(lambda: bool(samples(bench, since)), _STOPPED_S)
    if not is_sampling:
        await bench.request(Verb.START)
    demand(
        is_sampling,
        f"STOP was obeyed again: its transaction and {ANSWER_MEMORY - 1} others are to be remembered",
    )
    demand(again is not None, "the repeated command was not answered again")
    demand(again == first, "the repeated command was answered otherwise than before")


async def _answer_to_stop(bench: Bench, transaction: int) -> Acknowledgement | None:
    """Send STOP once; what was answered in time."""
    since = bench.mark()
    await bench.send_command(Verb.STOP, unique_id=bench.unique_id, transaction=transaction)
    if not await bench.answered(transaction, since):
        return None
    answer: Acknowledgement = bench.answers(transaction, since)[0].packet
    return answer


@rule("by_module_id", "a command to the module's id is obeyed, one to another id is not answered")
async def by_module_id(bench: Bench) -> None:
    """Give a command to its own id and to the next."""
    for module, is_meant in ((bench.module, True), ((bench.module + 1) % (MAX_MODULE + 1), False)):
        since = bench.mark()
        number = await bench.send_command(Verb.HELLO, encode_arguments(Verb.HELLO, *SUPPORTED), module=module)
        if is_meant:
            came = await bench.answered(number, since)
            demand(came, f"a command to module {module} was not answered")
        else:
            await demand_silence(bench, number, since, f"a command to module {module}")


@rule("by_unique_id", "a command with a unique id is obeyed by that device alone, whatever its module id")
async def by_unique_id(bench: Bench) -> None:
    """Give commands to a unique id that no device has, under headers that the module listens to."""
    since = bench.mark()
    hello_bytes = encode_arguments(Verb.HELLO, *SUPPORTED)
    for module in (BROADCAST, bench.module):
        number = await bench.send_command(Verb.HELLO, hello_bytes, module=module, unique_id=_WRONG_ID)
        await demand_silence(bench, number, since, f"a command to another unique id, under header {module},")


@rule("answer_to_all", "answers to 255 wait for 2 ms times the device's id")
async def answer_to_all(bench: Bench) -> None:
    """Look at the quickest of several answers: a busy host makes them late and never early."""
    delays = []
    for _ in range(5):
        since = bench.mark()
        number = bench.next_transaction()
        command = Command(number, Verb.HELLO, bytes(12), encode_arguments(Verb.HELLO, *SUPPORTED))
        sent_ns = await bench.send(command, BROADCAST)
        if await bench.answered(number, since, 1.0):
            delays.append((bench.answers(number, since)[0].arrived_ns - sent_ns) // 1000)
    demand(delays, "none of 5 commands to all was answered")
    least = BROADCAST_ANSWER_DELAY_US * bench.module
    demand(min(delays) >= 0.9 * least, f"module {bench.module} answered after {min(delays)} µs, not {least}")


@rule("damaged_command", "a damaged wire frame costs nothing but itself, and is not obeyed")
async def damaged_command(bench: Bench) -> None:
    """Send a command with a bit of its checksum turned, and a good one after it."""
    if bench.link.framing is not Framing.BYTE_STREAM:
        raise SkippedError("the bus keeps damage away")
    number, since = bench.next_transaction(), bench.mark()
    arguments = encode_arguments(Verb.HELLO, *SUPPORTED)
    frame = bench.frame(Command(number, Verb.HELLO, bench.unique_id, arguments), BROADCAST)
    data = bytearray(host_bytes(frame, bench.link.framing))
    # A byte that becomes 0 would end the frame there.
    data[-3] ^= 0x55 if data[-3] != 0x55 else 0x33
    await bench.write(bytes(data))
    await demand_silence(bench, number, since, "a command with a wrong checksum")


@rule("noise", "whole again at the delimiter, whatever the line has picked up")
async def noise(bench: Bench) -> None:
    """Send zeros, more bytes than any wire frame has, all values, and a frame that ends too soon."""
    if bench.link.framing is not Framing.BYTE_STREAM:
        raise SkippedError("the bus keeps noise away")
    for data in (bytes(64), bytes([0xAA]) * _OVERLONG + b"\0", bytes(range(256)) * 2 + b"\0", b"\x05\x01\0"):
        # In pieces: a line is no faster than what reads it.
        for start in range(0, len(data), 128):
            await bench.write(data[start : start + 128])
            await asyncio.sleep(0.002)
        answer = await bench.request(Verb.HELLO, *SUPPORTED)
        demand(
            answer,
            f"nothing was answered after {len(data)} bytes {data[:4].hex()}… within {PATIENCE_S:.0f} s",
        )


COMMANDING = (
    hello,
    hello_no_version,
    identify,
    get_info,
    unknown_verb,
    card_verbs,
    bad_arguments,
    read_settings,
    stop_and_start,
    repeated_command,
    by_module_id,
    by_unique_id,
    answer_to_all,
    damaged_command,
    noise,
)
