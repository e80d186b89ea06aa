"""Bounds on what a broker sends us."""

from __future__ import annotations

import asyncio
import contextlib

import aiomqtt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.outputs.connection import LARGEST_INBOX, LARGEST_MESSAGE, Allowance, Inbox, refuse_huge_packets


def message(size):
    return aiomqtt.Message("mocap/g/pose", bytes(size), 0, False, 0, None)


def test_an_inbox_is_full_by_bytes_and_by_number():
    inbox = Inbox(100)
    with pytest.raises(asyncio.QueueFull):
        inbox.put_nowait(message(LARGEST_MESSAGE + 1))
    for _ in range(LARGEST_INBOX // LARGEST_MESSAGE):
        inbox.put_nowait(message(LARGEST_MESSAGE))
    with pytest.raises(asyncio.QueueFull):
        inbox.put_nowait(message(1))
    inbox.get_nowait()
    inbox.put_nowait(message(LARGEST_MESSAGE))  # its bytes were given back
    told: list[str] = []
    small = Inbox(2, lambda: told.append("full"))
    for _ in range(2):
        small.put_nowait(message(1))
    assert told == []
    for size in (1, LARGEST_MESSAGE + 1):
        with pytest.raises(asyncio.QueueFull):
            small.put_nowait(message(size))
    assert told == ["full", "full"]


@given(st.lists(st.integers(0, LARGEST_MESSAGE + 5) | st.none(), max_size=200))
def test_what_waits_never_exceeds_its_bound(steps):
    inbox, sizes = Inbox(30), []
    for size in steps:
        with contextlib.suppress(asyncio.QueueFull, asyncio.QueueEmpty):
            if size is None:
                assert len(inbox.get_nowait().payload) == sizes.pop(0)
            else:
                inbox.put_nowait(message(size))
                sizes.append(size)
        assert sum(sizes) <= LARGEST_INBOX
        assert inbox.qsize() == len(sizes) <= 30


class Paho:
    def __init__(self, announced):
        self._in_packet = {"remaining_length": announced}
        self.is_closed = False

    def loop_read(self, max_packets=1):
        return max_packets

    def _sock_close(self):
        self.is_closed = True


@pytest.mark.parametrize(("announced", "is_refused"), [(0, False), (LARGEST_MESSAGE, False), (1 << 28, True)])
def test_a_huge_packet_ends_the_connection_before_it_has_come(announced, is_refused):
    client = Paho(announced)
    refuse_huge_packets(client)
    if is_refused:
        with pytest.raises(ConnectionError, match="message of 268435456 bytes"):
            client.loop_read()
    else:
        assert client.loop_read(7) == 7
    assert client.is_closed is is_refused


@given(st.lists(st.floats(0, 1), min_size=1, max_size=300))
def test_no_more_than_allowed_whatever_the_rhythm(waits):
    allowance, now_s, taken = Allowance(rate=10, burst=5), 100.0, 0
    for wait in waits:
        now_s += wait
        taken += allowance.takes(now_s)
        assert taken <= 5 + 10 * (now_s - 100.0 - waits[0]) + 1e-6


def test_whoever_keeps_to_the_rate_is_always_taken():
    allowance = Allowance(rate=10, burst=3)
    assert all(allowance.takes(5.0 + 0.1001 * n) for n in range(100))
    assert [allowance.takes(1000.0) for _ in range(5)] == [True] * 3 + [False] * 2
    assert not allowance.takes(999.0), "a clock that goes back gives nothing"
