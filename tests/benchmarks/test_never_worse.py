"""The judge itself: known errors come out as they are, nothing is both training and validation."""

import dataclasses
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.never_worse import peers, simulated, split, store
from benchmarks.never_worse.case import TURNED, Case, Variant, in_turned_world
from benchmarks.never_worse.judging import claims, errors, levelled
from benchmarks.never_worse.losses import (
    KNOCK,
    NOISE,
    SILENCES_S,
    with_knocks,
    with_losses,
    with_noise,
    with_silences,
)
from benchmarks.never_worse.objective import Objective, score
from benchmarks.never_worse.recordings import FAMILIES, backward, part
from benchmarks.never_worse.report import report
from benchmarks.never_worse.solving import Solution, live
from devices.recorded_tracks import ModuleTrack, RecordedTracks, ReferenceTrack
from gateway.frames import Status
from gateway.geometry.comparison import orientation_error

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[3] / "shared" / "data"))
BOTH, NEITHER = Variant(has_device=True, has_field=True), Variant(has_device=False, has_field=False)


@pytest.fixture(scope="module")
def chain() -> Case:
    """Two links that turn for some seconds."""
    case = simulated.slow_arm_case(3)
    n = 1200
    return dataclasses.replace(
        case, frames=case.frames[:n], truth=case.truth[:n], truth_later=case.truth_later[:n], is_spatial=True
    )


def turned(q: np.ndarray, world: Rotation, own: Rotation | None = None) -> np.ndarray:
    """Orientations (T, S, 4) turned in the world, and on their segments."""
    flat = world * Rotation.from_quat(q.reshape(-1, 4), scalar_first=True) * (own or Rotation.identity())
    return flat.as_quat(scalar_first=True).reshape(q.shape)


def test_nothing_is_training_and_validation():
    content = split.table()
    training, validation = (content[name] for name in split.PARTS)
    assert not set(training["recordings"]) & set(validation["recordings"])
    for kind, drawn in training["simulated"].items():
        assert not set(drawn["seeds"]) & set(validation["simulated"].get(kind, {"seeds": []})["seeds"])
    names = [one.name for one in split.named()]
    assert len(set(names)) == len(names)
    assert all(one.reason for one in split.named())


def test_every_name_of_the_split_can_be_made():
    for name in (name for each in split.PARTS for name in split.table()[each]["recordings"]):
        whole = name
        for end in split.CHANGES:
            whole = whole.removesuffix(end)
        kind, _, seed = whole.rpartition("_")
        assert whole.partition("_")[0] in FAMILIES or (kind in simulated.KINDS and seed.isdigit())
    for kind in (kind for each in split.PARTS for kind in split.table()[each]["simulated"]):
        assert kind in simulated.KINDS


def test_a_turned_world_turns_truth_field_and_devices_and_nothing_that_modules_feel():
    case = simulated.random_chain_case(5011)
    other = in_turned_world(case, "random_chain_5011_turned")
    first, turned_first = (
        next(frame for frame in each.frames if frame.local).local[0].value for each in (case, other)
    )
    turn = Rotation.from_rotvec([0.0, 0.0, TURNED])
    np.testing.assert_allclose(turned_first, turn.apply(first), atol=1e-12)
    np.testing.assert_allclose(other.suit.magnetic_field, turn.apply(case.suit.magnetic_field), atol=1e-9)
    for q, turned_q in zip(case.truth[::50, 0], other.truth[::50, 0], strict=True):
        wanted = turn * Rotation.from_quat(q, scalar_first=True)
        assert (wanted * Rotation.from_quat(turned_q, scalar_first=True).inv()).magnitude() < 1e-9
    for frame, same in zip(case.frames, other.frames, strict=True):
        assert frame.specific_force is same.specific_force


def test_a_tenth_of_the_samples_is_lost_the_same_ones_each_time(chain):
    lossy = with_losses(chain, "random_chain_1_lossy")
    lost = np.array([frame.status == Status.MISSING for frame in lossy.frames])
    assert 0.02 < lost.mean() < 0.3
    assert lossy.kind == "lossy"
    for frame, whole, is_lost in zip(lossy.frames, chain.frames, lost, strict=True):
        assert np.isnan(frame.angular_rate[is_lost]).all()
        assert np.array_equal(frame.angular_rate[~is_lost], whole.angular_rate[~is_lost])
    again = with_losses(chain, "random_chain_1_lossy")
    assert all(np.array_equal(a.status, b.status) for a, b in zip(lossy.frames, again.frames, strict=True))


def test_noise_of_poorer_sensors_is_the_same_each_time_and_as_large_as_it_says():
    arm = simulated.slow_arm_case(3)
    noisy, again = (with_noise(arm, "slow_arm_3_noisy") for _ in range(2))
    assert noisy.kind == "noisy"
    for sensor, sigma in NOISE.items():
        off, whole, same = (np.stack([getattr(f, sensor) for f in c.frames]) for c in (noisy, arm, again))
        assert np.array_equal(off, same, equal_nan=True)
        if np.isfinite(whole).all():
            assert np.std(off - whole) == pytest.approx(sigma, rel=0.05)


def test_modules_are_knocked_once_a_second_from_when_they_move_the_same_times_each_time():
    arm = simulated.fast_arm_case(3)
    knocked, again = (with_knocks(arm, "fast_arm_3_knocked") for _ in range(2))
    assert knocked.kind == "knocked"
    assert knocked.moves_from_s == pytest.approx(arm.moves_from_s, abs=0.2)
    for sensor, size in KNOCK.items():
        felt, whole, same = (np.stack([getattr(f, sensor) for f in c.frames]) for c in (knocked, arm, again))
        assert np.array_equal(felt, same)
        blows = np.linalg.norm(felt - whole, axis=2)
        hard = (blows > 0.9 * size).sum(axis=0) / (arm.times_s[-1] - arm.moves_from_s)
        assert hard.mean() == pytest.approx(1.0, rel=0.3)
        assert not blows[arm.times_s < arm.moves_from_s].any()


def test_modules_fall_silent_for_a_while_in_motion_the_same_ones_each_time():
    arm = simulated.fast_arm_case(3)
    silent = with_silences(arm, "fast_arm_3_silent")
    lost = np.array([frame.status == Status.MISSING for frame in silent.frames])
    assert 0.02 < lost.mean() < 0.3
    assert silent.kind == "silent"
    for module in range(lost.shape[1]):
        begins, ends = (np.flatnonzero(np.diff(lost[:, module].astype(int)) == step) for step in (1, -1))
        lengths_s = (ends - begins[: len(ends)]) * arm.interval_s
        assert (lengths_s >= SILENCES_S[0] - 1e-9).all()
        assert (lengths_s <= SILENCES_S[1] + arm.interval_s).all()
        rates = np.array([np.linalg.norm(arm.frames[k + 1].angular_rate[module]) for k in begins])
        assert (rates > 1.0).all()
    again = with_silences(arm, "fast_arm_3_silent")
    assert all(np.array_equal(a.status, b.status) for a, b in zip(silent.frames, again.frames, strict=True))


def test_every_set_of_recordings_is_assigned():
    if not DATA.is_dir():
        pytest.skip(f"no {DATA}")
    used = {"ring_chain5", "repoimu_pendulum", "repoimu_tstick", "broad", "gaitmap_foot"}
    assert used | set(split.table()["unused"]) == {path.name for path in DATA.iterdir() if path.is_dir()}
    tried = {one.name for one in split.named()}
    assert {f"broad_{path.name[:2]}" for path in (DATA / "broad").glob("*.mat")} <= tried
    sticks = (DATA / "repoimu_tstick").glob("*.csv")
    assert {f"tstick_{path.name.split('_')[1][-2:]}" for path in sticks} <= tried


def test_the_truth_has_no_error_and_one_heading_and_mounting_a_segment_are_taken_out(chain):
    exact = errors(chain, NEITHER, chain.truth)
    assert exact.total == pytest.approx(0.0, abs=1e-5)
    assert exact.relative == pytest.approx(0.0, abs=1e-5)
    askew = turned(chain.truth, Rotation.from_rotvec([0, 0, 1.0]), Rotation.from_rotvec([0.1, -0.2, 0.1]))
    found = errors(chain, BOTH, askew)
    assert found.total == pytest.approx(0.0, abs=1e-3)
    assert found.raw_total > 50.0
    assert found.relative == pytest.approx(0.0, abs=15.0)
    assert found.relative > 1.0, "a mounting that is off shows between segments that turn"


def test_a_tilt_that_comes_and_goes_is_counted(chain):
    n = len(chain.frames)
    angles = np.where(np.arange(n) % 2 == 0, 1.0, -1.0)[:, None] * np.radians([2.0, 0.0, 0.0])
    q = np.stack(
        [
            turned(chain.truth[:, [s]], Rotation.from_rotvec(angles))[:, 0]
            for s in range(chain.truth.shape[1])
        ],
        axis=1,
    )
    found = errors(chain, NEITHER, q)
    assert found.total == pytest.approx(2.0, abs=0.02)
    assert found.tilt == pytest.approx(2.0, abs=0.02)
    assert found.by_segment == pytest.approx((2.0, 2.0), abs=0.02)


def test_half_a_sample_later_is_judged_against_the_later_truth(chain):
    assert errors(chain, NEITHER, chain.truth_later, is_later=True).total == pytest.approx(0.0, abs=1e-5)
    assert errors(chain, NEITHER, chain.truth_later).total > 1e-3


@pytest.mark.parametrize("late_s", [0.0, 1.5, 4.0])
def test_the_time_until_headings_are_right(chain, late_s):
    moving = np.stack([np.linalg.norm(f.angular_rate, axis=1) for f in chain.frames]).max(axis=1) > 0.5
    begins_s = chain.times_s[int(np.argmax(moving))]
    off = np.where(chain.times_s < begins_s + late_s, np.radians(20.0), 0.0)
    q = chain.truth.copy()
    q[:, 1] = turned(q[:, [1]], Rotation.from_rotvec(off[:, None] * np.array([0.0, 0.0, 1.0])))[:, 0]
    assert errors(chain, NEITHER, q).heading_start_s == pytest.approx(late_s, abs=0.03)


@pytest.mark.parametrize(("claimed", "nees"), [(1.0, 1.0), (0.5, 4.0)])
def test_honest_claims_are_told_from_others(claimed, nees):
    case = simulated.long_rest_case(4)
    rng = np.random.default_rng(1)
    n, sigma = len(case.frames), np.radians([1.0, 2.0, 5.0])
    off = Rotation.from_rotvec(rng.standard_normal((n, 3)) * sigma)
    covariance = np.broadcast_to(np.diag((claimed * sigma) ** 2), (n, 1, 3, 3))
    total = np.full((n, 1), claimed * np.linalg.norm(sigma))
    found = claims(case, BOTH, Solution(turned(case.truth, off), total, covariance))
    assert found.nees == pytest.approx(nees, rel=0.1)
    assert len(found.nees_by_time) == 10
    assert found.nees_by_segment == pytest.approx((found.nees,))
    if claimed == 1.0:
        assert found.in_ellipsoid_percent == pytest.approx(95.0, abs=1.5)
        assert 93.0 < found.covered_percent < 98.0
    else:
        assert found.in_ellipsoid_percent < 70.0


def test_a_truth_is_set_right_that_gravity_contradicts():
    """Where nothing else says what the truth's world is, and by more than could be an acceleration."""
    case = dataclasses.replace(simulated.ring_like_case(4), is_world_known=False)
    askew, hardly = (
        turned(case.truth, Rotation.from_rotvec([np.radians(angle), 0.0, 0.0])) for angle in (5.0, 0.2)
    )
    found = orientation_error(levelled(case, askew), case.truth)
    assert np.degrees(found.inclination).max() < 0.6
    assert levelled(case, hardly) is hardly
    assert levelled(dataclasses.replace(case, is_world_known=True), askew) is askew
    assert levelled(with_losses(case, "ring_like_4_lossy"), askew) is askew


def test_kinds_weigh_alike_and_only_what_is_worse_is_punished():
    better, worse = {BOTH: 0.5, NEITHER: 0.5}, {NEITHER: 2.0}
    many = {f"a_{k}": ("a", better) for k in range(9)}
    found = score(many | {"b_1": ("b", worse)})
    assert found.mean_ratio == pytest.approx(1.0)
    assert found.penalty == pytest.approx(0.5)
    assert found.value == pytest.approx(1.5)
    assert score(many).penalty == 0.0
    assert "b_1" in str(found)


def test_changes_of_the_table_are_tried_in_processes_of_their_own(monkeypatch):
    monkeypatch.setattr(split, "named", lambda part: [split.Named("fast_arm_1", part, "quick")])
    with Objective(processes=1) as objective:
        ours, careless = objective(), objective({"specific_force": 5.0})
    assert 0.0 < ours.value < careless.value


def test_a_recording_backward_turns_as_its_reference_does():
    times = np.arange(0.0, 4.0, 0.01)
    angle = np.sin(2.0 * times)
    q = Rotation.from_rotvec(angle[:, None] * np.array([0.3, 0.0, 0.7]))
    rate = (2.0 * np.cos(2.0 * times))[:, None] * np.array([0.3, 0.0, 0.7])
    forces = np.tile([0.0, 0.0, 9.81], (len(times), 1))
    module = ModuleTrack(1, "module", times, forces, rate, np.full_like(rate, np.nan))
    reference = ReferenceTrack("module", times, q.as_quat(scalar_first=True))
    recording = part(backward(RecordedTracks("r", 100.0, (module,), (reference,))), 1.0, 3.0)
    (track,), (truth,) = recording.modules, recording.references
    at = np.searchsorted(truth.times, track.times[5] - 1e-6)
    pair = Rotation.from_quat(truth.q_wb[at : at + 2], scalar_first=True)
    seen = (pair[0].inv() * pair[1]).as_rotvec() / 0.01
    np.testing.assert_allclose(seen, track.angular_rate[5:7].mean(axis=0), atol=1e-3)
    assert track.times[0] == pytest.approx(0.0, abs=1e-9)
    assert track.times[-1] < 2.0


@pytest.mark.parametrize("kind", ["slow_arm", "clipped", "triple_pendulum", "ring_like"])
def test_a_seed_is_one_recording(kind):
    one, again, other = (simulated.KINDS[kind](seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(one.frames[-1].angular_rate, again.frames[-1].angular_rate)
    np.testing.assert_array_equal(one.frames[-1].magnetic_field, again.frames[-1].magnetic_field)
    assert not np.array_equal(one.frames[-1].angular_rate, other.frames[-1].angular_rate)
    assert one.truth.shape == (len(one.frames), one.suit.skeleton.n_segments, 4)
    assert np.isfinite(one.truth).all()


def test_kinds_are_what_they_are_called():
    clipped = np.stack([frame.angular_rate for frame in simulated.clipped_case(7).frames])
    assert np.abs(clipped).max() == simulated.GYROSCOPE_LIMIT
    assert np.sum(np.abs(clipped) == simulated.GYROSCOPE_LIMIT) > 50
    assert not simulated.slow_arm_case(7).has_field
    ring = simulated.ring_like_case(7)
    knee = Rotation.from_quat(ring.truth[:, 1], scalar_first=True).inv() * Rotation.from_quat(
        ring.truth[:, 2], scalar_first=True
    )
    np.testing.assert_allclose(knee.as_rotvec()[:, 1:], 0.0, atol=1e-9)
    away = simulated.iron(np.array([[0.0, 0, 0], [30.0, 0, 0]]), np.random.default_rng(1), np.zeros(3))
    assert np.linalg.norm(away[0]) > 1.0
    assert np.linalg.norm(away[1]) < 0.01


def test_vqf_is_level_where_gravity_is():
    case = simulated.long_rest_case(5)
    found = peers.vqf(case)
    assert set(found) == {"VQF 6", "VQF 9", "VQF offline 6", "VQF offline 9"}
    assert errors(case, BOTH, found["VQF 9"]).raw_tilt < 2.0


def test_peers_that_are_not_there_are_named(monkeypatch):
    monkeypatch.setattr(peers, "versions", dict)
    told = "\n".join(peers.skipped())
    for name in ("imufusion", "ahrs", "qmt", "imt-ring", peers.VARIABLE):
        assert name in told


def test_an_interpreter_that_is_none_is_named(monkeypatch):
    monkeypatch.setenv(peers.VARIABLE, sys.executable + "-not-there")
    peers.versions.cache_clear()
    with pytest.raises(RuntimeError, match="not-there"):
        peers.versions()
    peers.versions.cache_clear()


def test_what_is_kept_is_made_once_and_made_again_where_it_is_damaged(tmp_path, monkeypatch):
    monkeypatch.setenv("MOCAP_BENCH_CACHE", str(tmp_path))
    made = []

    def make() -> int:
        made.append(1)
        return 5

    assert [store.kept("a", make) for _ in range(3)] == [5, 5, 5]
    assert len(made) == 1
    (tmp_path / "a.pickle").write_bytes(b"\x80")
    assert store.kept("a", make) == 5
    assert len(made) == 2


def test_live_is_what_the_service_publishes(chain):
    solution = live("joint", chain, NEITHER)
    assert solution.q_wb.shape == chain.truth.shape
    assert solution.covariance is not None
    assert errors(chain, NEITHER, solution.q_wb).tilt < 3.0
    sigma = np.sqrt(np.einsum("tsii->ts", solution.covariance[-1:]))
    np.testing.assert_allclose(np.minimum(sigma, 3.2), solution.sigma[-1:], rtol=1e-6)


def test_a_report_of_nothing_has_no_figures_that_are_nan():
    assert report([]).figures == []
