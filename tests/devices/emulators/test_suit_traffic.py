"""What a suit sends, as the gateway's decoders see it."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.emulators.delivery import Encoding, Transmission
from devices.emulators.device.relay_device import EmulatedRelay
from devices.emulators.device.sender import Sender, Timed
from devices.emulators.imperfections import IDEAL, ROUGH, TYPICAL, Imperfections, ModuleClock
from devices.emulators.motion.motions import robot_arm_motion, walking_motion
from devices.emulators.motion.waves import Fade
from devices.emulators.sensing.ideal_sensors import GRAVITY, MAGNETIC_FIELD, sense
from devices.emulators.sensing.sample_encoding import SampleEncoder
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Framing
from firmware_protocol import (
    RELAY,
    CanFrameDecoder,
    Defect,
    DeviceInfo,
    FrameDecoder,
    Health,
    InertialSample,
    InertialSampleFine,
    LocalMeasurement,
    PacketDecoder,
    WireFrame,
    encode_frame,
    encode_packet,
)
from firmware_protocol.samples import SENSORS

AT_ONCE = Fade(rest_s=0.0, ramp_s=0.5)
CAN, CAN_FD = Encoding(Framing.CAN), Encoding(Framing.CAN, is_fd=True)


def decode(transmissions, frames=None):
    decoder = PacketDecoder(frames or FrameDecoder())
    packets = [received for t in transmissions for received in decoder.feed(t.data)]
    return packets, decoder.dropped


def samples_of(packets, module, packet_class=InertialSample):
    return [p for p in packets if p.module == module and isinstance(p.packet, packet_class)]


def array(samples, sensor):
    return np.array([getattr(s.packet, sensor) for s in samples])


@pytest.fixture
def arm_motion(arm4):
    return robot_arm_motion(arm4, 1, AT_ONCE)


def test_ideal_traffic_is_the_truth(arm_motion, arm4):
    traffic = SuitTraffic(arm_motion, SuitSettings(is_fine=True))
    packets, dropped = decode(traffic.transmissions(2.0))
    assert not dropped
    t = np.arange(200) * 0.01
    R_bs = Rotation.from_quat(arm4.sensor_to_segment, scalar_first=True).as_matrix()
    truth = sense(arm_motion.state(t), arm4.module_positions, R_bs, GRAVITY, MAGNETIC_FIELD)
    for module in range(4):
        samples = samples_of(packets, module, InertialSampleFine)
        assert [s.module_time_us for s in samples] == [k * 10_000 for k in range(200)]
        assert [s.sequence for s in samples] == list(range(200))
        for sensor, step in (("specific_force", 1e-5), ("magnetic_field", 1e-4), ("angular_rate", 1e-6)):
            np.testing.assert_allclose(
                array(samples, sensor), getattr(truth, sensor)[:, module], atol=0.51 * step
            )


def test_transmissions_are_in_order_of_time_and_seeded(human17):
    motion = walking_motion(human17, 1)
    first, again, other = (
        list(SuitTraffic(motion, None, ROUGH, seed).transmissions(2.0)) for seed in (5, 5, 6)
    )
    assert [t.time_s for t in first] == sorted(t.time_s for t in first)
    assert first == again
    assert first != other


def test_traffic_does_not_depend_on_the_block(arm_motion):
    settings = SuitSettings(has_relay=True)
    whole = SuitTraffic(arm_motion, settings, TYPICAL).transmissions(3.0)
    cut = SuitTraffic(arm_motion, dataclasses.replace(settings, block_s=0.07), TYPICAL).transmissions(3.0)
    for one, other in zip(whole, cut, strict=True):
        assert one.data == other.data
        assert one.time_s == pytest.approx(other.time_s, abs=1e-12)


def test_modules_introduce_themselves_and_tell_their_health(arm_motion):
    packets, _ = decode(SuitTraffic(arm_motion, SuitSettings(sampling_rate_hz=50.0)).transmissions(7.0))
    for module in range(4):
        infos = samples_of(packets, module, DeviceInfo)
        healths = samples_of(packets, module, Health)
        assert [info.module_time_us for info in infos] == [0, 5_000_000]
        assert len(healths) == 7
        assert infos[0].packet.gyroscope_sampling_rate == pytest.approx(50.0)
        assert (
            infos[0].packet.unique_id != samples_of(packets, (module + 1) % 4, DeviceInfo)[0].packet.unique_id
        )
        assert healths[-1].packet.uptime_s == 6
        # Of samples at k/50 s, as many as lie before the report.
        assert [h.packet.samples_taken for h in healths] == [-(-h.module_time_us // 20_000) for h in healths]
    assert isinstance(packets[0].packet, DeviceInfo)


def test_skew_and_phase_show_in_the_time_stamps(human17):
    imperfections = Imperfections(clock_skew_ppm=3000.0, has_random_phase=True)
    traffic = SuitTraffic(walking_motion(human17, 1), SuitSettings(), imperfections, seed=2)
    arrivals, stamps = defaultdict(list), defaultdict(list)
    decoder = PacketDecoder(FrameDecoder())
    for t in traffic.transmissions(10.0):
        for received in decoder.feed(t.data):
            if isinstance(received.packet, InertialSample):
                arrivals[received.module].append(t.time_s)
                stamps[received.module].append(received.module_time_us * 1e-6)
    skews = []
    for module in range(17):
        skew, offset = np.polyfit(arrivals[module], stamps[module], 1)
        assert skew - 1 == pytest.approx(traffic.senders[module].clock.skew, abs=1e-7)
        assert offset == pytest.approx(0.0, abs=1e-6)
        np.testing.assert_allclose(np.diff(stamps[module]), 0.01, atol=1.1e-6)
        skews.append(skew)
    assert np.std(skews) > 1e-3
    assert len({stamps[module][0] for module in range(17)}) == 17


def test_counters_wrap_when_asked(arm_motion):
    traffic = SuitTraffic(arm_motion, None, Imperfections(wraps_after_s=0.5))
    stamps = [s.module_time_us for s in samples_of(decode(traffic.transmissions(1.0))[0], 2)]
    assert stamps[0] == 2**32 - 500_000
    assert stamps[49:52] == [2**32 - 10_000, 0, 10_000]


def test_loss_and_duplicates_are_as_asked_and_every_packet_is_accounted_for(human17):
    imperfections = Imperfections(loss=0.05, duplication=0.02, jitter=0.004)
    traffic = SuitTraffic(walking_motion(human17, 1), None, imperfections, seed=3)
    packets, dropped = decode(traffic.transmissions(10.0))
    counts = traffic.counts
    assert counts["lost"] == pytest.approx(0.05 * counts["sent"], rel=0.1)
    assert counts["duplicated"] == pytest.approx(0.02 * counts["sent"], rel=0.15)
    assert len(packets) == counts["sent"] - counts["lost"] + counts["duplicated"]
    assert not dropped
    seen = {s.sequence for s in samples_of(packets, 4)}
    assert len(seen) == pytest.approx(950, abs=30)
    assert max(seen) >= 990


@pytest.mark.parametrize(("encoding", "frames"), [(Encoding(), FrameDecoder), (CAN, CanFrameDecoder)])
def test_corrupted_frames_are_found_out(human17, encoding, frames):
    traffic = SuitTraffic(
        walking_motion(human17, 1), SuitSettings(encoding=encoding), Imperfections(corruption=0.02), seed=3
    )
    packets, dropped = decode(traffic.transmissions(5.0), frames())
    corrupted = traffic.counts["corrupted"]
    assert corrupted == pytest.approx(0.02 * traffic.counts["sent"], rel=0.2)
    # A byte turned to a zero ends a stuffed frame early, one frame may so count as two bad ones.
    assert len(packets) == traffic.counts["sent"] - corrupted
    assert corrupted <= sum(dropped.values()) <= 1.2 * corrupted


def test_jitter_delays_but_keeps_each_modules_order(arm_motion):
    imperfections = Imperfections(latency=0.002, jitter=0.005, batching=0.016)
    traffic = SuitTraffic(arm_motion, None, imperfections)
    decoder, delays, sequences = PacketDecoder(FrameDecoder()), [], defaultdict(list)
    for t in traffic.transmissions(10.0):
        assert t.time_s / 0.016 == pytest.approx(round(t.time_s / 0.016), abs=1e-6)
        for received in decoder.feed(t.data):
            if isinstance(received.packet, InertialSample):
                delays.append(t.time_s - received.module_time_us * 1e-6)
                sequences[received.module].append(received.sequence)
    assert min(delays) >= 0.002
    assert 0.012 < np.mean(delays) < 0.025
    assert all(sequence == list(range(1000)) for sequence in sequences.values())


def test_a_relay_sends_one_batch_a_tick_with_every_module(arm_motion):
    direct, _ = decode(SuitTraffic(arm_motion).transmissions(2.0))
    relayed_traffic = list(SuitTraffic(arm_motion, SuitSettings(has_relay=True)).transmissions(2.0))
    relayed, dropped = decode(relayed_traffic)
    assert not dropped
    assert len(relayed_traffic) == 200

    def by_sender(packets):
        return sorted(packets, key=lambda p: (p.module, p.kind, p.sequence))

    assert {packet.relayed_us for packet in relayed} == set(range(1000, 2_000_000, 10_000))
    assert by_sender(dataclasses.replace(packet, relayed_us=None) for packet in relayed) == by_sender(direct)


def test_a_tick_too_full_for_one_frame_goes_out_in_several():
    body = encode_packet(InertialSampleFine(*[(1.0, 2.0, 3.0)] * 3))
    waiting = [
        Timed(0.0, WireFrame(InertialSampleFine.KIND, module, sequence, 0, body))
        for sequence in range(10)
        for module in range(30)
    ]
    relay = EmulatedRelay(Sender(RELAY, ModuleClock(start_us=0, skew=0.0, phase_s=0.0)), tick_s=0.1)
    batches = relay.gather(waiting, 0.1)
    packets, dropped = decode([Transmission(t.time_s, encode_frame(t.frame)) for t in batches])
    assert not dropped
    assert len(batches) == 4  # 46 bytes an entry, 88 entries in 4083 bytes
    assert [t.frame.sequence for t in batches] == [0, 1, 2, 3]
    assert [(p.sequence, p.module) for p in packets] == [divmod(k, 30) for k in range(300)]
    assert relay.gather([], 0.3) == []


@pytest.mark.parametrize("encoding", [CAN, CAN_FD], ids=["classic", "fd"])
def test_the_same_packets_over_can(arm_motion, encoding):
    over_bytes, _ = decode(SuitTraffic(arm_motion).transmissions(1.0))
    over_can, dropped = decode(
        SuitTraffic(arm_motion, SuitSettings(encoding=encoding)).transmissions(1.0), CanFrameDecoder()
    )
    assert not dropped
    assert over_can == over_bytes


def test_a_relay_cannot_be_on_a_can_bus(arm_motion):
    with pytest.raises(ValueError, match="CAN cannot carry"):
        SuitTraffic(arm_motion, SuitSettings(has_relay=True, encoding=CAN))


def test_local_devices_send_their_measurements_with_noise(human17):
    motion = walking_motion(human17, 1, AT_ONCE)
    packets, _ = decode(SuitTraffic(motion).transmissions(20.0))
    sent = samples_of(packets, 40, LocalMeasurement)
    assert len(sent) == 200
    state = motion.state(np.array([s.module_time_us * 1e-6 for s in sent]))
    truth = state.joint_position[:, 0] + state.R_wb[:, 0] @ np.array([0.0, 0.1, 0.0])
    error = np.array([s.packet.value for s in sent]) - truth
    assert error.std() == pytest.approx(0.01, rel=0.1)
    assert sent[0].packet.quantity == 3
    assert sent[0].packet.sigma == pytest.approx((0.01,) * 3)


def test_sensors_that_are_not_worn_are_not_sent(arm_motion):
    settings = SuitSettings(sensors=("specific_force", "magnetic_field"))
    packets, _ = decode(SuitTraffic(arm_motion, settings).transmissions(0.5))
    assert samples_of(packets, 1)[0].packet.angular_rate is None
    assert samples_of(packets, 1)[0].packet.magnetic_field is not None
    assert samples_of(packets, 1, DeviceInfo)[0].packet.gyroscope_range is None


def test_modules_may_have_rates_of_their_own(arm_motion):
    settings = SuitSettings(module_rates_hz={2: 250.0})
    packets, _ = decode(SuitTraffic(arm_motion, settings).transmissions(2.0))
    assert [len(samples_of(packets, module)) for module in range(4)] == [200, 200, 500, 200]


def test_a_segment_without_a_module_sends_nothing(arm4):
    bare = dataclasses.replace(arm4, module_ids=np.array([5, -1, -1, 9]))
    packets, _ = decode(SuitTraffic(robot_arm_motion(bare, 1)).transmissions(0.5))
    assert {p.module for p in packets} == {5, 9}


@pytest.mark.parametrize("packet", [InertialSample, InertialSampleFine])
@pytest.mark.parametrize("sensors", [SENSORS, ("angular_rate", "specific_force"), ("magnetic_field",)])
def test_block_encoding_equals_the_packets_own(packet, sensors):
    rng = np.random.default_rng(8)
    spread = {"specific_force": 80.0, "magnetic_field": 900.0, "angular_rate": 18.0}
    if packet is InertialSampleFine:
        spread = {name: 1e3 * sigma for name, sigma in spread.items()}
    values = {name: rng.normal(0, spread[name], (300, 3)) for name in sensors}
    bodies = SampleEncoder(packet, sensors).encode(values)
    rows = zip(*(values[name].tolist() for name in sensors), strict=True)
    one_by_one = [
        encode_packet(packet(**{name: tuple(v) for name, v in zip(sensors, row, strict=True)}))
        for row in rows
    ]
    assert bodies == one_by_one
    assert any(body[0] & 0b0111_0000 for body in bodies)  # some were clipped


def test_an_unknown_sensor_is_named():
    with pytest.raises(ValueError, match="barometer"):
        SampleEncoder(InertialSample, ("barometer",))


def test_a_bad_crc_is_what_corruption_makes(arm_motion):
    traffic = SuitTraffic(arm_motion, None, dataclasses.replace(IDEAL, corruption=1.0))
    packets, dropped = decode(traffic.transmissions(1.0))
    assert not packets
    assert set(dropped) <= {Defect.BAD_CRC, Defect.BAD_STUFFING, Defect.TOO_SHORT, Defect.OVERLONG}
