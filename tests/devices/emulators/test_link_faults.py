"""Transmissions on a faulty link: when their bytes arrive, and in how many pieces."""

import pytest

from devices.emulators.delivery import Transmission
from devices.emulators.faults.fault_plan import FaultPlan
from devices.emulators.faults.faulty_suit import LinkFaults
from devices.link import Framing

DRIP = FaultPlan.model_validate(
    {"faults": [{"kind": "slow_drip", "at": 1.0, "lasts": 1.0, "bytes_per_s": 100.0}]}
)


def test_a_slow_line_gives_a_byte_at_a_time_and_what_is_left_at_its_end_at_once():
    sent = [Transmission(1.0 + 0.1 * k, bytes([k]) * 30) for k in range(10)]
    arrived = LinkFaults(DRIP, Framing.BYTE_STREAM).rest(sent)
    assert b"".join(each.data for each in arrived) == b"".join(each.data for each in sent)
    dripped = [each for each in arrived if each.time_s < 2.0]
    assert [each.time_s for each in dripped] == pytest.approx([1.0 + 0.01 * (n + 1) for n in range(99)])
    assert all(len(each.data) == 1 for each in dripped)
    left = arrived[len(dripped) :]
    assert {each.time_s for each in left} == {2.0}
    assert len(left) <= len(sent)  # not a piece a byte: tens of thousands of a whole suit's second


def test_can_frames_come_whole_over_a_slow_line():
    sent = [Transmission(1.0, bytes(30)), Transmission(1.1, bytes(30)), Transmission(3.0, bytes(30))]
    arrived = LinkFaults(DRIP, Framing.CAN).rest(sent)
    assert [(round(each.time_s, 3), len(each.data)) for each in arrived] == [(1.3, 30), (1.6, 30), (3.0, 30)]
