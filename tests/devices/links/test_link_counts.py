"""Every byte that a link took is somewhere, over all its connections; so is what the system lost before."""

from __future__ import annotations

import array
import asyncio
import errno
import socket

from hypothesis import given
from hypothesis import strategies as st

from devices.links import link_counts, udp_link
from devices.links.arrivals import Arrivals
from devices.links.link_counts import LinkCounts, LostBefore, SerialErrors
from devices.links.udp_link import UdpLink
from tests.patience import PATIENCE_S


@given(st.lists(st.tuples(st.integers(1, 50), st.booleans()), max_size=60))
def test_bytes_are_handed_on_or_dropped_or_waiting(steps):
    """Sizes that come, and whether one chunk is read after each; a new connection in the middle."""
    counts = LinkCounts()

    async def run() -> None:
        for part in (steps[: len(steps) // 2], steps[len(steps) // 2 :]):
            arrivals = Arrivals("suit", limit_bytes=100, counts=counts)
            for size, reads in part:
                arrivals.put(bytes(size), 1)
                if reads:
                    await anext(arrivals)
                assert counts.taken == counts.handed + counts.behind + counts.waiting
            arrivals.end()
            async for _ in arrivals:
                pass

    asyncio.run(run())
    assert counts.taken == sum(size for size, _ in steps)
    assert counts.waiting == 0


async def test_datagrams_that_the_kernel_dropped_are_counted_over_connections(monkeypatch):
    monkeypatch.setattr(udp_link, "_RECEIVE_BUFFER_BYTES", 4096)
    link = UdpLink()
    dropped = 0
    for _ in range(2):
        await link.open()
        dropped = await overflow(link, dropped)
        await link.close()
    assert link.counts.losses == dropped


async def overflow(link: UdpLink, dropped_before: int) -> int:
    """Send more than fits while nobody reads, then go on until the drops are told; how many there were."""
    sent = received = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        for _ in range(200):
            sent += peer.sendto(b"x" * 100, link.address) == 100
        async with asyncio.timeout(PATIENCE_S):
            while received + link.counts.losses - dropped_before < sent:
                received += (await anext(aiter(link))).data == b"x" * 100
                if link.counts.losses == dropped_before:
                    sent += peer.sendto(b"x" * 100, link.address) == 100  # told with what fits
    assert link.counts.before[LostBefore.KERNEL_OVERFLOW] - dropped_before == sent - received > 0
    return link.counts.losses


def serial_driver(monkeypatch, counters):
    """A driver whose counters are (frame, overrun, parity, buffer overrun), or who has none."""

    def ioctl(_descriptor: int, request: int, answer: array.array) -> int:
        assert request == 0x545D
        if counters is None:
            raise OSError(errno.ENOTTY, "no counters")
        answer[6], answer[7], answer[8], answer[10] = counters
        return 0

    monkeypatch.setattr(link_counts.fcntl, "ioctl", ioctl)


def test_a_serial_drivers_overruns_count_from_the_opening_on(monkeypatch):
    counters = [5, 7, 11, -1]  # the kernel's are of 32 bits without a sign
    serial_driver(monkeypatch, counters)
    counts = LinkCounts()
    errors = SerialErrors(counts, 3)
    errors.look()
    assert counts.losses == 0
    counters[:] = [6, 9, 11, 0]
    errors.look()
    assert counts.before == {LostBefore.SERIAL_OVERRUN: 3, LostBefore.SERIAL_DAMAGED: 1}
    again = SerialErrors(counts, 3)  # opened again: what was before is not counted twice
    again.look()
    assert counts.losses == 4
    assert counts.summary()["serial_overrun"] == 3


def test_a_driver_without_counters_is_left_alone(monkeypatch):
    serial_driver(monkeypatch, None)
    counts = LinkCounts()
    SerialErrors(counts, 3).look()
    assert counts.losses == 0
