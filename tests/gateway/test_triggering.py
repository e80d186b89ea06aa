"""The shell of unified control: what is noted of what was sent, and how the timer is kept."""

import asyncio

from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from firmware_protocol import (
    BROADCAST,
    FrameDecoder,
    InertialSample,
    PacketDecoder,
    SamplingTrigger,
    encode_frame,
    wire_frame,
)
from gateway.clocks import TriggerAnswers
from gateway.service.host_sender import HostSender
from gateway.service.triggering import PreciseAlarm, Triggerer
from gateway.sources.clock_mode import ClockMode
from gateway.sources.module_table import ModuleTable
from gateway.sources.suit import SuitSource
from tests.patience import PATIENCE_S

MS = 1_000_000


class FakeLink:
    """Takes what is written after a while, or not at all."""

    framing = Framing.BYTE_STREAM

    def __init__(self, name="a", delay_s=0.0, error=None):
        self.name = name
        self.written = []
        self._delay_s = delay_s
        self._error = error

    async def write(self, data, _to=()):
        if self._error is not None:
            raise self._error
        if self._delay_s:
            await asyncio.sleep(self._delay_s)
        self.written.append((gateway_time_ns(), data))


def trigger_frame(number=0):
    return wire_frame(SamplingTrigger(number), BROADCAST, number, 0)


async def test_what_left_is_noted_with_the_moment_before_the_write():
    noted, link = [], FakeLink()
    before_ns = gateway_time_ns()
    sent = await HostSender(noted.append).send(link, trigger_frame())
    assert noted == [sent]
    assert before_ns <= sent.sent_ns <= link.written[0][0]
    assert (sent.data, sent.link) == (link.written[0][1], "a")


async def test_what_did_not_leave_or_nobody_knows_when_is_not_noted():
    noted = []
    sender = HostSender(noted.append)
    assert await sender.send(FakeLink(error=LinkError("away")), trigger_frame()) is None
    slow = FakeLink(delay_s=0.02)
    assert await sender.send(slow, trigger_frame(), within_ns=2 * MS) is None
    assert noted == []
    assert await sender.send(slow, trigger_frame()) is not None  # a bound is all that it is wanted for


async def test_an_alarm_goes_off_in_time_and_one_gone_by_at_once():
    alarm = PreciseAlarm()
    try:
        for ahead_ns in (-MS, 0, 3 * MS, 7 * MS):
            instant_ns = gateway_time_ns() + ahead_ns
            await asyncio.wait_for(alarm.wait_until(instant_ns), PATIENCE_S)
            assert gateway_time_ns() >= instant_ns
    finally:
        alarm.close()


async def test_a_link_that_hangs_keeps_no_other_from_its_triggers(caplog, until):
    answers = TriggerAnswers((1,), 100 * MS)
    stream = SuitSource(ModuleTable(ClockMode.TRIGGER), answers)
    good, stuck = FakeLink("good"), FakeLink("stuck", delay_s=2 * PATIENCE_S)
    for link in (good, stuck):
        stream.add_link(link.name, link.framing)
    triggerer = Triggerer([stuck, good], HostSender(stream.sent), answers, rate_hz=100)
    alone = wire_frame(InertialSample(angular_rate=(0.0, 0.0, 0.0)), 1, 0, 0)
    stream.receive(Chunk(encode_frame(alone), gateway_time_ns(), "good"))
    running = asyncio.create_task(triggerer.run())
    await until(lambda: len(good.written) >= 5 and triggerer.timer.figures.unsent >= 5)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    figures = triggerer.timer.figures
    assert figures.sent == len(good.written)
    assert stuck.written == []
    numbers = [PacketDecoder(FrameDecoder()).feed(data)[0].packet.number for _, data in good.written]
    assert numbers == list(range(len(numbers)))
    assert "module 1 samples on its own timer" in caplog.text
