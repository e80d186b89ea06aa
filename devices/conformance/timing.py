"""Rules of time requests: the module's clock, sent with as little delay as it can and truly."""

from __future__ import annotations

import asyncio

from devices.conformance.bench import ArrivedPacket, Bench
from devices.conformance.rule import demand, rule
from firmware_protocol import BROADCAST, MAX_MODULE, SyncRequest, SyncResponse
from firmware_protocol.commands import Verb

_EXCHANGES = 12
_PAUSE_S = 0.05
_STAMPS = 2**32
_DRIFT_US = 2_000
"""That two clocks may part by during the exchanges, with a crystal as bad as they come, µs."""
_SLOW_US = 50_000


async def exchange(bench: Bench, module: int) -> tuple[int, int, ArrivedPacket] | None:
    """Ask for the time once: when it was sent (ns), the token, the answer; None: none came."""
    token = bench.next_transaction()
    since = bench.mark()
    sent_ns = await bench.send(SyncRequest(token, 0), module)

    def answers() -> list[ArrivedPacket]:
        return [each for each in bench.from_module(SyncResponse, since) if each.packet.token == token]

    await bench.until(lambda: bool(answers()), 1.0)
    return (sent_ns, token, answers()[0]) if answers() else None


async def _several(bench: Bench, module: int) -> list[tuple[int, int, ArrivedPacket]]:
    found = []
    for _ in range(_EXCHANGES):
        done = await exchange(bench, module)
        if done is not None:
            found.append(done)
        await asyncio.sleep(_PAUSE_S)
    return found


@rule("time_request", "a SyncRequest is answered at once, with its token")
async def time_request(bench: Bench) -> None:
    """Ask several times, and look how long the module says that it held the requests."""
    found = await _several(bench, bench.module)
    demand(
        len(found) >= _EXCHANGES // 2, f"{len(found)} of {_EXCHANGES} requests were answered within a second"
    )
    held = sorted((each.packet.sent_us - each.packet.received_us) % _STAMPS for _, _, each in found)
    # Below zero, the difference of two counters wraps to the upper half.
    demand(held[-1] < _STAMPS // 2, "sent_us is before received_us")
    demand(
        held[len(held) // 2] < _SLOW_US,
        f"half of the requests were held for {held[len(held) // 2] / 1000:.0f} "
        "ms or more, by the module's own word",
    )


@rule(
    "time_reported_truly",
    "received_us is the counter when the request came, sent_us when the answer goes to the line",
)
async def time_reported_truly(bench: Bench) -> None:
    """Look whether one offset between both clocks explains all answers, to what a bad crystal drifts."""
    found = await _several(bench, bench.module)
    demand(found, "no request was answered")
    least, most = _offsets_us(found)
    demand(
        least <= most + _DRIFT_US,
        f"no one offset fits all answers: they are {(least - most) / 1000:.1f} ms apart",
    )
    newest = found[-1][2]
    apart = _later_us(newest.received.module_time_us, newest.packet.received_us)
    demand(
        abs(apart) < 1_000_000, f"the answer is stamped {apart} µs from received_us: it is another counter"
    )


def _offsets_us(found: list[tuple[int, int, ArrivedPacket]]) -> tuple[float, float]:
    """Return the least and the greatest offset of the host's clock that exchanges allow, µs.

    The module's clock plus the offset lies between sending and arrival: in every exchange, so in all.
    """
    first = found[0][2].packet.received_us
    least = [sent_ns * 1e-3 - _later_us(each.packet.received_us, first) for sent_ns, _, each in found]
    most = [each.arrived_ns * 1e-3 - _later_us(each.packet.sent_us, first) for _, _, each in found]
    return max(least), min(most)


def _later_us(stamp_us: int, than_us: int) -> int:
    """Return by how much a stamp is later than another, or earlier, on a counter that wraps."""
    return (stamp_us - than_us + _STAMPS // 2) % _STAMPS - _STAMPS // 2


@rule("time_request_to_all", "a SyncRequest to 255 is answered too")
async def time_request_to_all(bench: Bench) -> None:
    """Ask three times: an answer may be lost."""
    answered = [await exchange(bench, BROADCAST) for _ in range(3)]
    demand(any(each is not None for each in answered), "none of 3 requests was answered")


@rule("time_request_to_another", "a SyncRequest to another module is not answered")
async def time_request_to_another(bench: Bench) -> None:
    """Ask the next number, then something that is answered: by then the other answer would have come."""
    since = bench.mark()
    other = (bench.module + 1) % (MAX_MODULE + 1)
    token = bench.next_transaction()
    await bench.send(SyncRequest(token, 0), other)
    demand(await bench.request(Verb.HELLO, 1, 1), "HELLO is not answered")
    wrong = [each for each in bench.from_module(SyncResponse, since) if each.packet.token == token]
    demand(not wrong, f"a request to module {other} was answered")


TIMING = (time_request, time_reported_truly, time_request_to_all, time_request_to_another)
