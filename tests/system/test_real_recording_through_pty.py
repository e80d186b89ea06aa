"""Real motion, also byte by byte, through a pseudo-terminal and a real broker, scored by a subscriber."""

from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.data_sets import read_ring_chain5
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.playback import play
from devices.emulators.transports import PtyTransport
from gateway.body.rig import load_rig
from gateway.emulation.recordings import orientations, score, solve

pytestmark = pytest.mark.system


def first_part(recording, seconds):
    """The recording's first seconds; its references stay whole."""

    def cut(track, *names):
        n = int(np.searchsorted(track.times, seconds))
        return replace(track, times=track.times[:n], **{name: getattr(track, name)[:n] for name in names})

    sensors = ("specific_force", "angular_rate", "magnetic_field")
    return replace(
        recording,
        modules=tuple(cut(track, *sensors) for track in recording.modules),
        local=tuple(cut(track, "values") for track in recording.local),
    )


@pytest.mark.parametrize(
    ("reconstructor", "seconds", "is_byte_by_byte"),
    [("independent", 66.0, False), ("articulated", 18.0, True)],
)
async def test_a_subscriber_sees_the_same_errors_as_an_offline_run(
    gateway_on, recording_set, tmp_path, reconstructor, seconds, is_byte_by_byte
):
    recording = first_part(read_ring_chain5(recording_set("ring_chain5") / "trial1"), seconds)
    suit = load_rig("chain_5")
    offline = solve(recording, suit, reconstructor)
    first_s = float(recording.modules[0].times[0])
    expected = score(*orientations(offline, first_s), recording)

    port = tmp_path / "suit"
    transport = PtyTransport(port)
    emulated = EmulatedSuit(play(recording), transport, speed=None, is_byte_by_byte=is_byte_by_byte)
    async with gateway_on(str(port), "chain_5", reconstructor, recording.sampling_rate_hz) as running:
        await emulated.run()
        await running.until_quiet(emulated.counts.sent_bytes)
    poses = [received.pose for received in running.received]
    assert len(poses) == len(offline)

    names, undefined = suit.skeleton.segment_names, [np.nan] * 4
    q_wb = np.array([[pose.segments[name] or undefined for name in names] for pose in poses])
    times_s = first_s + (np.array([pose.t_ns for pose in poses]) - poses[0].t_ns) * 1e-9
    measured = score(times_s, q_wb, recording)
    print(f"\n{reconstructor}\n  offline     {expected}\n  subscriber  {measured}")
    np.testing.assert_allclose(measured.total, expected.total, atol=1e-6)
    np.testing.assert_allclose(measured.tilt, expected.tilt, atol=1e-6)
    assert np.isfinite(measured.total).all()
