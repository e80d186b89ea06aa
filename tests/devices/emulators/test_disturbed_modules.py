"""Taps, shakes, buttons, wrong ids, and modules that nobody wears."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.emulators.bench import bench_suit
from devices.emulators.imperfections import IDEAL
from devices.emulators.sensing.disturbances import Shake, Tap, felt
from devices.emulators.sensing.ideal_sensors import GRAVITY
from firmware_protocol import DeviceInfo, Event, InertialSample
from firmware_protocol.commands import Result, Verb

BUTTON, TAP, DOUBLE_TAP, SHAKE = 1, 2, 3, 4


def norms(host, module, sensor):
    samples = host.of(InertialSample, module)
    times = np.array([s.module_time_us for s in samples]) * 1e-6
    return times, np.linalg.norm([getattr(s.packet, sensor) for s in samples], axis=1)


@given(st.floats(0.0, 0.01, exclude_max=True))
def test_a_tap_is_seen_at_100_hz_at_whatever_phase(phase):
    force, rate = Tap(1.0).at(1.0 + phase + 0.01 * np.arange(100))
    assert np.linalg.norm(force, axis=1).max() > 11.0
    assert np.linalg.norm(rate, axis=1).max() > 0.8
    assert not force[30:].any()


def test_a_shake_comes_back_to_where_it_began():
    times = np.linspace(0.0, 4.0, 40_001)
    shake = Shake(1.0, 2.0)
    force, rate = shake.at(times)
    outside = (times < 1.0) | (times >= 3.0)
    assert not force[outside].any()
    assert not rate[outside].any()
    assert np.linalg.norm(rate, axis=1).max() > 5.0
    np.testing.assert_allclose(np.trapezoid(rate, times, axis=0), 0.0, atol=1e-6)


def test_what_does_not_last_then_is_not_felt():
    both = [Tap(1.0), Shake(1.1, 1.0)]
    assert felt(both, np.array([0.2, 0.9])) is None
    force, rate = felt(both, np.array([1.05, 1.2]))
    alone = both[1].at(np.array([1.05, 1.2]))
    np.testing.assert_allclose(force[1], alone[0][1] + both[0].at(np.array([1.2]))[0][0])
    assert rate.shape == (2, 3)


def test_a_tap_shows_in_that_module_alone_and_is_told(host_of):
    host = host_of(bench_suit(4, 1, is_fresh=False, imperfections=IDEAL))
    traffic = host.traffic
    traffic.tap("module_3", 1.0)
    traffic.tap(traffic.device(2).unique_id, 2.0, times=2)
    traffic.press_button(1, 3.0)
    host.listen(4.0)
    times, force = norms(host, 3, "specific_force")
    is_hit = (times >= 1.0) & (times < 1.3)
    assert force[is_hit].max() > 20.0
    np.testing.assert_allclose(force[~is_hit], 9.80665, atol=0.01)
    times, rate = norms(host, 2, "angular_rate")
    assert rate[(times >= 2.0) & (times < 2.2)].max() > 1.0
    assert rate[(times >= 2.25) & (times < 2.4)].max() > 1.0
    assert norms(host, 1, "angular_rate")[1].max() == norms(host, 4, "angular_rate")[1].max() == 0.0
    events = {(p.module, p.packet.event): at for p, at in _events(host)}
    assert set(events) == {(3, TAP), (2, DOUBLE_TAP), (1, BUTTON)}
    assert events[3, TAP] == pytest.approx(1.03, abs=0.01)
    assert events[1, BUTTON] == pytest.approx(3.0, abs=0.01)


def _events(host):
    return [
        (p, at) for p, at in zip(host.packets, host.arrived_s, strict=True) if isinstance(p.packet, Event)
    ]


def test_the_module_in_the_hand_is_the_one_that_moves(host_of):
    host = host_of(bench_suit(10, 2, is_fresh=False))
    host.traffic.shake(7, 1.0, 2.0)
    host.listen(4.0)
    spread = {n: norms(host, n, "angular_rate")[1].std() for n in range(1, 11)}
    assert max(spread, key=spread.get) == 7
    assert spread[7] > 20 * sorted(spread.values())[-2]
    assert [(p.module, p.packet.event) for p, _ in _events(host)] == [(7, SHAKE)]


def test_modules_on_a_table_lie_still_and_flat(host_of):
    host = host_of(bench_suit(10, 5, is_fresh=False, imperfections=IDEAL))
    host.listen(1.0)
    ups = []
    for n in range(1, 11):
        samples = [s.packet for s in host.of(InertialSample, n)]
        assert len({(s.specific_force, s.magnetic_field) for s in samples}) == 1
        assert samples[0].angular_rate == (0.0, 0.0, 0.0)
        assert samples[0].specific_force[:2] == pytest.approx((0.0, 0.0), abs=0.005)
        assert abs(samples[0].specific_force[2]) == pytest.approx(-GRAVITY[2], abs=0.005)
        ups.append(samples[0].specific_force[2] > 0)
    assert len(set(ups)) == 2
    headings = {host.of(InertialSample, n)[0].packet.magnetic_field[:2] for n in range(1, 11)}
    assert len(headings) == 10


def test_ten_fresh_modules_are_told_apart_and_numbered(host_of):
    host = host_of(bench_suit(10, 3, imperfections=IDEAL))
    host.listen(0.5)
    assert {p.module for p in host.packets} == {0}
    found = sorted({p.packet.unique_id for p in host.of(DeviceInfo)})
    assert len(found) == len({a.unique_id for a in host.tell(Verb.HELLO, 1, 1)}) == 10
    for module_id, unique_id in enumerate(found, start=20):
        host.write("module_id", module_id, unique_id=unique_id)
        assert host.ask(Verb.COMMIT, unique_id=unique_id).result == Result.DONE
    host.listen(0.1)
    assert {p.module for p in host.listen(0.5)} == set(range(20, 30))


@pytest.mark.parametrize("n", [0, 64])
def test_a_bench_has_room_for_so_many(n):
    with pytest.raises(ValueError, match="1 to 63"):
        bench_suit(n, 1)


def test_swapped_modules_send_under_each_others_ids(arm_host):
    straight, swapped = arm_host(), arm_host(stored_ids={1: 2, 2: 1})
    for host in (straight, swapped):
        host.listen(2.0)
    for module, other in ((1, 2), (2, 1), (3, 3)):
        readings = [p.packet for p in straight.of(InertialSample, module)]
        assert [p.packet for p in swapped.of(InertialSample, other)] == readings
    ids = {p.module: p.packet.unique_id for p in swapped.of(DeviceInfo)}
    assert ids[1] == straight.traffic.device(2).unique_id


def test_two_modules_of_one_id_both_send(arm_host):
    host = arm_host(stored_ids={2: 1})
    host.listen(1.0)
    assert len(host.of(InertialSample, 1)) == 200
    assert len({p.packet.unique_id for p in host.of(DeviceInfo, 1)}) == 2


def test_an_unknown_device_is_named_with_those_there_are(arm_host):
    with pytest.raises(KeyError, match=r"elbow.*upper"):
        arm_host().traffic.tap("elbow", 1.0)
