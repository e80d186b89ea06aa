"""Simulated time passes where tasks sleep, and nowhere else."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest

from devices.link import gateway_time_ns
from tests.simulated_time import in_simulated_time


def test_gateway_time_and_the_loops_pass_as_tasks_sleep():
    async def slept():
        begun_ns, begun_s = gateway_time_ns(), time.monotonic()
        await asyncio.gather(asyncio.sleep(3600), asyncio.sleep(1800))
        return gateway_time_ns() - begun_ns, time.monotonic() - begun_s

    of_gateway_ns, of_loop_s = in_simulated_time(slept())
    assert of_gateway_ns == pytest.approx(3600e9, abs=10)
    assert of_loop_s == pytest.approx(3600.0)


def test_time_stands_still_while_a_thread_works():
    async def worked():
        begun_s, may_end = time.monotonic(), threading.Event()
        working = asyncio.create_task(asyncio.to_thread(may_end.wait, 60.0))
        other = asyncio.create_task(asyncio.sleep(1.0))
        threading.Timer(0.05, may_end.set).start()
        assert await working
        assert not other.done()
        at_end_s = time.monotonic() - begun_s
        await other
        return at_end_s, time.monotonic() - begun_s

    assert in_simulated_time(worked()) == pytest.approx((0.0, 1.0))


def test_a_time_out_that_is_over_ends_what_would_never():
    async def never():
        async with asyncio.timeout(60.0):
            await asyncio.Event().wait()

    with pytest.raises(TimeoutError):
        in_simulated_time(never())


def test_real_time_is_back_afterwards():
    monotonic = time.monotonic
    in_simulated_time(asyncio.sleep(10.0))
    assert time.monotonic is monotonic
