"""Clock exchanges over a real port: the transport's delay leaves the modules' clocks."""

import asyncio
import statistics

import pytest

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import Imperfections
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from tests.patience import PATIENCE_S
from tests.running_suit import running

pytestmark = pytest.mark.system

DELAYED = Imperfections(latency=0.006, jitter=0.0005, clock_skew_ppm=50.0, has_random_clock_start=True)


HEARD = 150
"""Samples of each module before its clock is judged: at first it is known from few."""


async def clock_errors_us(folder, broker_port, sync_rate_hz, are_settled):
    """Error of every module's clock against the emulator's truth, µs, and the bounds it gives, once
    ``are_settled(errors)``. A busy machine has few moments without a delay of its own."""
    port = folder / "suit"
    settings = GatewaySettings(
        gateway="lab",
        links=[{"name": "suit", "url": str(port)}],
        rig="robot_arm_4",
        reconstructor="independent",
        clock={"sync_rate_hz": sync_rate_hz},
        mqtt={"port": broker_port},
    )
    suit = load_rig("robot_arm_4")
    traffic = SuitTraffic(move(dress(suit), suit.skeleton.name, 1), SuitSettings(), DELAYED, 1)
    emulated = EmulatedSuit(traffic, PtyTransport(port))
    service = Service(settings, suit)
    modules = service.pipeline.stream.modules
    found = [], []
    async with running(emulated):
        serving = asyncio.create_task(service.run())
        try:
            async with asyncio.timeout(PATIENCE_S):
                while len(modules) < 4 or min(each.received for each in modules.values()) < HEARD:
                    await asyncio.sleep(0.05)
                while not are_settled((found := errors_and_bounds(service, traffic, emulated))[0]):
                    await asyncio.sleep(0.2)
        except TimeoutError:
            pytest.fail(f"not settled: errors and bounds are {found} µs; {service.statistics()}")
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
    return found


def errors_and_bounds(service, traffic, emulated):
    """Of all modules that have been heard, now."""
    errors, bounds = [], []
    for module, record in service.pipeline.stream.modules.items():
        clock = traffic.senders[module].clock
        figures = record.clock.figures()
        now_s = emulated.motion_time_s(record.last_arrival_ns)
        true_offset_ns = emulated.instant_ns(now_s) - clock.count_us(now_s * (1 + clock.skew)) * 1000
        errors.append((figures.offset_ns - true_offset_ns) * 1e-3 % (2**32))
        bounds.append(figures.bound_us)
    return [e - 2**32 if e > 2**31 else e for e in errors], bounds


async def test_exchanges_take_the_delay_out(tmp_path, mosquitto):
    without, no_bounds = await clock_errors_us(
        tmp_path, mosquitto.port, 0, lambda errors: statistics.median(errors) < 9000
    )
    assert 5000 < statistics.median(without) < 9000  # a delay of 6 ms and more cannot be told from an offset
    assert no_bounds == [None] * 4
    errors, bounds = await clock_errors_us(
        tmp_path, mosquitto.port, 10, lambda errors: max(map(abs, errors)) < 3000
    )
    assert len(errors) == 4
    for error, bound in zip(errors, bounds, strict=True):
        assert abs(error) < bound
        assert abs(error) < 3000
