"""Readers of the data sets against known values, and recordings played as their modules sent them."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.emulators.data_sets import (
    LOCAL_DEVICE,
    read_broad,
    read_hipose_mtw17,
    read_repoimu_pendulum,
    read_repoimu_tstick,
    read_ring_chain5,
)
from devices.emulators.delivery import Encoding
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.playback import CLOCK_START_US, play
from devices.emulators.transports import MemoryTransport
from devices.link import Framing
from devices.recorded_tracks import LocalTrack, ModuleTrack, RecordedTracks
from firmware_protocol import (
    CanFrameDecoder,
    DeviceInfo,
    FrameDecoder,
    InertialSampleFine,
    LocalMeasurement,
    PacketDecoder,
)


def decode(transmissions, frames=None):
    decoder = PacketDecoder(frames or FrameDecoder())
    packets = [received for t in transmissions for received in decoder.feed(t.data)]
    assert not decoder.dropped
    return packets


@pytest.fixture
def recording():
    """Two modules, one without magnetometer, the other with lost rows; a local device with a gap."""
    rng = np.random.default_rng(3)
    times = np.arange(50) / 40.0
    acc, gyr, mag = rng.normal(0, 5, (3, 50, 3))
    lost = acc.copy()
    lost[[7, 8, 30]] = np.nan
    position = rng.normal(size=(20, 3))
    position[4] = np.nan
    return RecordedTracks(
        "made",
        40.0,
        (
            ModuleTrack(5, "bare", times, acc, gyr, np.full((50, 3), np.nan)),
            ModuleTrack(6, "gappy", times + 0.003, lost, gyr, mag),
        ),
        local=(LocalTrack(60, "bare", np.arange(20) / 30.0 - 0.02, 3, position, 0.001),),
    )


def by_module(packets, packet_class):
    sorted_out = defaultdict(list)
    for received in packets:
        if isinstance(received.packet, packet_class):
            sorted_out[received.module].append(received)
    return sorted_out


def test_playing_sends_what_was_recorded(recording):
    samples = by_module(decode(play(recording)), InertialSampleFine)
    bare = samples[5]
    assert [s.module_time_us for s in bare] == [CLOCK_START_US + 25_000 * k for k in range(50)]
    assert {s.packet.magnetic_field for s in bare} == {None}
    read = np.array([s.packet.specific_force for s in bare])
    np.testing.assert_allclose(read, recording.modules[0].specific_force, atol=0.51e-5)


def test_lost_rows_are_not_sent_but_counted(recording):
    samples = by_module(decode(play(recording)), InertialSampleFine)[6]
    assert [s.sequence for s in samples] == [k for k in range(50) if k not in (7, 8, 30)]
    assert samples[7].module_time_us == CLOCK_START_US + 9 * 25_000 + 3000


def test_local_measurements_come_at_their_times(recording):
    packets = by_module(decode(play(recording)), LocalMeasurement)[60]
    assert [p.sequence for p in packets] == [k for k in range(20) if k != 4]
    assert packets[0].module_time_us == CLOCK_START_US - 20_000
    np.testing.assert_allclose(packets[0].packet.value, recording.local[0].values[0], rtol=1e-6)
    assert packets[0].packet.quantity == 3


def test_modules_introduce_themselves_first(recording):
    packets = decode(play(recording))
    infos = by_module(packets, DeviceInfo)
    assert set(infos) == {5, 6}
    assert infos[5][0].packet.magnetometer_range is None
    assert infos[6][0].packet.gyroscope_sampling_rate == pytest.approx(40.0)
    first_of_5 = next(p for p in packets if p.module == 5)
    assert isinstance(first_of_5.packet, DeviceInfo)


def test_playing_is_in_order_deterministic_and_the_same_over_can(recording):
    played = list(play(recording))
    times = [t.time_s for t in played]
    assert times == sorted(times)
    assert played == list(play(recording))
    assert decode(play(recording, Encoding(Framing.CAN)), CanFrameDecoder()) == decode(played)


def test_counters_wrap_in_a_long_recording(recording):
    late = dataclasses.replace(recording.modules[0], times=recording.modules[0].times + 4293.5)
    samples = by_module(decode(play(RecordedTracks("late", 40.0, (late,)))), InertialSampleFine)[5]
    stamps = [s.module_time_us for s in samples]
    assert max(stamps) > 2**32 - 25_000
    assert min(stamps) < 25_000
    assert set(np.diff(stamps) % 2**32) == {25_000}


async def test_a_suit_plays_a_recording(recording):
    memory = MemoryTransport()
    await EmulatedSuit(play(recording), memory, speed=None, linger_s=0.0).run()
    assert b"".join(data for _, data in memory.chunks) == b"".join(t.data for t in play(recording))


def test_ring_chain5(recording_set):
    rigid = read_ring_chain5(recording_set("ring_chain5") / "trial1")
    assert rigid.module_ids == (1, 2, 3, 4, 5)
    first = rigid.modules[0]
    assert first.specific_force.shape == (2650, 3)
    np.testing.assert_allclose(first.times[[0, 1, -1]], [0.0, 0.025, 66.225])
    np.testing.assert_allclose(first.specific_force[0], [0.46382965, 0.09796803, 9.75106061], atol=1e-8)
    assert np.linalg.norm(first.magnetic_field, axis=1).mean() == pytest.approx(50.0)
    raw_mag = [-0.39669771, 0.11467318, -0.56002020]
    np.testing.assert_allclose(first.magnetic_field[0], np.multiply(raw_mag, first.magnetic_scale), atol=1e-5)
    reference = rigid.reference("segment_1")
    np.testing.assert_allclose(reference.q_wb[0], [0.968976, -0.001061, -0.022133, -0.246159], atol=1e-6)
    assert np.diff(reference.times) == pytest.approx(1 / 30)
    assert [int(np.isnan(rigid.reference(f"segment_{n}").q_wb).any(axis=1).sum()) for n in range(1, 6)] == [
        221,
        220,
        214,
        0,
        212,
    ]


def test_ring_chain5_root_position(recording_set):
    trial = recording_set("ring_chain5") / "trial1"
    mean, marker = (
        read_ring_chain5(trial).local[0],
        read_ring_chain5(trial, "nonrigid", root_marker=1).local[0],
    )
    assert mean.module == LOCAL_DEVICE
    np.testing.assert_allclose(marker.values[0], [-0.498121, 1.445471, -0.065762], atol=1e-6)
    assert mean.values[0, 0] == pytest.approx(np.mean([-0.498121, -0.469324, -0.288559, -0.329383]), abs=1e-6)
    assert mean.values.shape == (1988, 3)


def test_ring_chain5_modules_and_optics_show_one_motion(recording_set):
    """The times of both are on one clock: angular rates agree best without a shift."""
    recording = read_ring_chain5(recording_set("ring_chain5") / "trial1")
    module, reference = recording.modules[3], recording.reference("segment_4")
    turned = Rotation.from_quat(reference.q_wb, scalar_first=True)
    optical = (turned[:-1].inv() * turned[1:]).magnitude() * 30.0
    at = (reference.times[1:] + reference.times[:-1]) / 2
    rate = np.linalg.norm(module.angular_rate, axis=1)

    def mismatch(shift):
        return np.sqrt(np.mean((np.interp(at + shift, module.times, rate) - optical)[90:-90] ** 2))

    shifts = np.arange(-0.1, 0.1, 0.005)
    assert abs(shifts[np.argmin([mismatch(s) for s in shifts])]) <= 0.011


def test_broad(recording_set):
    recording = read_broad(recording_set("broad") / "10_undisturbed_slow_translation_A.mat")
    module = recording.modules[0]
    assert module.specific_force.shape == (55409, 3)
    assert np.diff(module.times) == pytest.approx(0.0035)
    assert np.linalg.norm(module.magnetic_field, axis=1).mean() == pytest.approx(43.6, abs=0.1)
    assert int(np.isnan(recording.local[0].values).any(axis=1).sum()) == 42
    short = dataclasses.replace(recording, modules=(cut(module, 500),), local=(cut(recording.local[0], 500),))
    packets = decode(play(short))
    assert len(by_module(packets, InertialSampleFine)[1]) == 500
    assert len(by_module(packets, LocalMeasurement)[LOCAL_DEVICE]) == 500


def cut(track, n):
    arrays = {f.name: getattr(track, f.name) for f in dataclasses.fields(track)}
    return dataclasses.replace(
        track, **{name: value[:n] for name, value in arrays.items() if isinstance(value, np.ndarray)}
    )


def test_repoimu_tstick(recording_set):
    recording = read_repoimu_tstick(recording_set("repoimu_tstick") / "TStick_Test02_Trial1.csv")
    module = recording.modules[0]
    assert module.times.shape == (8993,)
    assert module.times[:2] == pytest.approx([0.08, 0.09])
    np.testing.assert_allclose(module.specific_force[0], [-0.071594, 0.21157, 9.7958])
    np.testing.assert_allclose(module.angular_rate[1], [0.000533, -0.007287, -0.000957])
    assert np.diff(module.times) == pytest.approx(0.01)
    assert not np.isnan(recording.reference("module").q_wb).any()


def test_repoimu_pendulum(recording_set):
    recording = read_repoimu_pendulum(recording_set("repoimu_pendulum"))
    assert [m.name for m in recording.modules] == ["segment_1", "segment_2", "segment_3"]
    for module in recording.modules:
        n = len(module.times)
        assert (np.diff(module.times) > 0).all()
        assert n / np.ptp(module.times) == pytest.approx(49.9, abs=0.2)
        assert (np.diff(module.angular_rate, axis=0) != 0).any(axis=1).all()
        # Interpolated between its changes: no more staircase.
        moving = np.linalg.norm(module.angular_rate, axis=1) > 1.0
        still = (np.diff(module.specific_force, axis=0) == 0).all(axis=1)
        assert still[moving[1:]].mean() < 0.02
    np.testing.assert_allclose(recording.modules[0].specific_force[0], [9.7412, 0.11035, 0.13574])
    # A row with a decimal comma in an exponent: "-8,00E-05".
    reference = recording.reference("segment_3")
    row = int(np.argmin(np.abs(reference.times - 33.68)))
    # The source's X, which is down, becomes −Z; a half turn of its axes leaves X up the segment.
    source = np.array([0.99977, -8e-5, -0.00068531, 0.021426])
    half = np.sqrt(0.5)
    half_turned = source * [1.0, -1.0, -1.0, 1.0]
    turned = half * (
        half_turned + np.array([half_turned[2], -half_turned[3], -half_turned[0], half_turned[1]])
    )
    sign = np.sign(reference.q_wb[row] @ turned)
    np.testing.assert_allclose(reference.q_wb[row], sign * turned, atol=1e-5)
    assert 50 < int(np.isnan(reference.q_wb).any(axis=1).sum()) < 400


def test_repoimu_pendulum_reference_turns_as_the_gyroscopes_do(recording_set):
    """About the axis of the swing and about that across it; the third, along the link, hardly turns."""
    recording = read_repoimu_pendulum(recording_set("repoimu_pendulum"))
    for module in recording.modules:
        reference = recording.reference(module.name)
        known = np.isfinite(reference.q_wb).all(axis=1)
        q_wb = Rotation.from_quat(np.where(known[:, None], reference.q_wb, 1.0), scalar_first=True)
        span = reference.times[3:] - reference.times[:-3]
        whole = known[3:] & known[:-3] & (span > 0.02) & (span < 0.1)
        rate = (q_wb[:-3].inv() * q_wb[3:]).as_rotvec()[whole] / span[whole, None]
        assert np.linalg.norm(rate, axis=1).max() < 15.0  # upside down for parts of a second nowhere
        at = 0.5 * (reference.times[3:] + reference.times[:-3])[whole]
        measured = np.stack([np.interp(at, module.times, axis) for axis in module.angular_rate.T], axis=1)
        for axis in (1, 2):
            assert np.corrcoef(measured[:, axis], rate[:, axis])[0, 1] > 0.3


def test_hipose_mtw17(recording_set):
    recording = read_hipose_mtw17(recording_set("hipose_mtw17"))
    assert len(recording.modules) == 17
    pelvis = next(m for m in recording.modules if m.name == "pelvis")
    assert pelvis.module == 0x2D
    assert np.diff(pelvis.times) == pytest.approx(1 / 60)
    hand = next(m for m in recording.modules if m.name == "right_hand")
    np.testing.assert_allclose(hand.specific_force[0], [9.892981, 0.290398, 0.402953])
    packets = by_module(decode(play(recording)), InertialSampleFine)
    assert {module: len(samples) for module, samples in packets.items()} == dict.fromkeys(
        recording.module_ids, 1253
    )


def test_hipose_reference_world_is_east_north_up(recording_set):
    """At rest the reference turns gravity up, and the magnetic field to the north and down."""
    recording = read_hipose_mtw17(recording_set("hipose_mtw17"))
    headings = []
    for module in recording.modules:
        q_wb = Rotation.from_quat(recording.reference(module.name).q_wb[:120], scalar_first=True)
        up = q_wb.apply(module.specific_force[:120]).mean(axis=0)
        assert up[2] / np.linalg.norm(up) > 0.98
        field = q_wb.apply(module.magnetic_field[:120]).mean(axis=0)
        headings.append(field[:2] / np.linalg.norm(field[:2]))
    east, north = np.mean(headings, axis=0)
    assert north > 0.85
    assert abs(east) < 0.4


def test_what_is_not_there_is_named(tmp_path, recording):
    with pytest.raises(FileNotFoundError, match="three are needed"):
        read_repoimu_pendulum(tmp_path)
    with pytest.raises(FileNotFoundError, match="MTw"):
        read_hipose_mtw17(tmp_path)
    with pytest.raises(KeyError, match="no reference for 'head'"):
        recording.reference("head")
