"""Headings that were shown wrongly are given back, and what is known of each is told apart from the rest."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.emulation.fast_arm import sampled
from gateway.emulation.random_chains import drawn
from gateway.geometry.rotation_matrix import from_rotation_vector
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings, JointReconstructor
from gateway.reconstruction.inertial.tree.start import forget_evidence, gather_heading, shown_heading
from gateway.reconstruction.inertial.tree.state import initial_state
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.reconstructor import update_many

CHAIN, RATE_HZ, TURNED = drawn(5001), 100.0, 1
WITHOUT_FIELD = ChainSettings(uses_field=False)


@pytest.fixture(scope="module")
def frames():
    return sampled(CHAIN.suit, CHAIN.motion, CHAIN.switches, CHAIN.seed, RATE_HZ)[:2400]


def relative_turn_deg(one, other):
    """Between orientations of the turned segment against its parent, degrees; (T,)."""
    p = CHAIN.suit.skeleton.parents[TURNED]
    apart = []
    for a, b in zip(one, other, strict=True):
        q = [np.array([x.q_wb[p], x.q_wb[TURNED]]) for x in (a, b)]
        headings = [np.unwrap([heading(x[0]), heading(x[1])]) for x in q]
        difference = (headings[0][1] - headings[0][0]) - (headings[1][1] - headings[1][0])
        apart.append(np.degrees(np.arctan2(np.sin(difference), np.cos(difference))))
    return np.abs(apart)


def heading(q):
    """Of a quaternion, rad: its turn about the vertical."""
    return 2.0 * np.arctan2(q[3], q[0])


def wrongly_turned(state, angle):
    """A saved state whose segment, and all beyond it, head otherwise, and are sure of it."""
    turn, segments = from_rotation_vector(np.array([0.0, 0.0, angle])), state["segments"].copy()
    beyond = {TURNED}
    for s, p in enumerate(CHAIN.suit.skeleton.parents):
        beyond |= {s} if p in beyond else set()
    for s in beyond:
        segments["R"][s] = turn @ segments["R"][s]
        averages = segments["averages"]
        averages["lever_arm_matrix"][s] = turn @ averages["lever_arm_matrix"][s]
        for name in ("force", "last_force"):
            averages[name][s] = turn @ averages[name][s]
        segments["velocity"]["felt"][s] = turn @ segments["velocity"]["felt"][s]
    for name in ("along", "across", "length", "seconds"):  # what has shown it right is not to be had
        segments["heading_sums"][name][TURNED] = 0.0
    return state | {"segments": segments}


def gone_on(frames, angle, **changes):
    """Poses after a segment was turned wrongly, and those of a filter that was let alone."""
    settings = replace(WITHOUT_FIELD, tuning=tuning(**changes))
    alone, turned = (JointReconstructor(CHAIN.suit, 1.0 / RATE_HZ, settings) for _ in range(2))
    update_many(alone, frames[:1000])
    turned.set_state(wrongly_turned(alone.state(), angle))
    return update_many(turned, frames[1000:]), update_many(alone, frames[1000:])


@pytest.mark.parametrize("angle", [2.0, -2.6, 3.1])
def test_a_heading_that_was_shown_wrongly_is_taken_back(frames, angle):
    off = relative_turn_deg(*gone_on(frames, angle))
    assert off[0] > 90.0
    assert off[-200:].max() < 10.0


def test_one_that_is_never_taken_back_stays_wrong_for_long(frames):
    """The reason for taking it back: a linearised filter that is sure of a heading does not find another."""
    kept, back = (
        relative_turn_deg(*gone_on(frames, 3.1, heading_contradiction=contradiction))
        for contradiction in (1e9, tuning().heading_contradiction)
    )
    assert np.mean(kept > 20.0) > np.mean(back > 20.0)


@pytest.mark.parametrize(("uses_field", "of_root"), [(False, "held"), (True, "by field")])
def test_certainty_tells_tilt_heading_and_neighbours_apart(frames, uses_field, of_root):
    suit = replace(CHAIN.suit, local_devices=())
    reconstructor = JointReconstructor(suit, 1.0 / RATE_HZ, ChainSettings(uses_field=uses_field))
    assert reconstructor.certainty() == {}
    update_many(reconstructor, frames)
    told = reconstructor.certainty()
    assert list(told) == list(suit.skeleton.segment_names)
    for s, (name, parent) in enumerate(zip(told, suit.skeleton.parents, strict=True)):
        one = told[name]
        assert one["heading"] == (of_root if parent < 0 else "observed")
        assert one["sigma_tilt"] < np.radians(5.0)
        assert (one["sigma_relative"] is None) == (parent < 0), s
        if parent >= 0 and not uses_field:  # one degree of a joint is not hidden behind what north is
            assert one["sigma_relative"] < 0.3 < one["sigma_heading"]


@pytest.mark.parametrize("uses_field", [False, True])
@pytest.mark.parametrize("is_aided", [False, True])
def test_tilts_are_told_as_sure_as_the_joints_around_them_agree(frames, uses_field, is_aided):
    """But for what all of an unaided body have in common, which no joint shows."""
    suit, used = CHAIN.suit if is_aided else replace(CHAIN.suit, local_devices=()), tuning()
    reconstructor = JointReconstructor(suit, 1.0 / RATE_HZ, ChainSettings(uses_field=uses_field))
    covariance = np.empty((len(frames), suit.skeleton.n_segments, 2, 3, 3))
    poses = reconstructor.update_many(frames, None, covariance)
    segments, parents = reconstructor.state()["segments"], suit.skeleton.parents
    at_rest, g_square = used.force_bias**2 / float(suit.gravity @ suit.gravity), suit.gravity @ suit.gravity
    told = reconstructor.certainty()
    tilts = [np.trace(P[:2, :2]) for P in segments["P"]]
    for s, name in enumerate(suit.skeleton.segment_names):
        around = [segments["joint_nis"][k] for k, p in enumerate(parents) if p >= 0 and s in (k, p)]
        share = used.tilt_nis * np.mean(around)
        assert share < 1.0
        in_common = 0.0 if is_aided else (1.0 - share) * min(tilts) / tilts[s]
        felt = segments["felt_square"][s]  # beside gravity it shows the tilt, and no constant error
        lasting = at_rest * (g_square / (g_square + 2.0 * felt)) ** 2
        tilt = (share + in_common) * segments["P"][s, :2, :2] + lasting * np.eye(2)
        np.testing.assert_allclose(covariance[-1, s, 1, :2, :2], tilt)
        assert not covariance[-1, s, 1, 2, :2].any()
        of_heading = covariance[-1, s, 1, 2, 2]
        if uses_field:
            assert of_heading == segments["compass"]["error_variance"][s] < used.unknown_heading**2
        else:
            assert of_heading == used.unknown_heading**2
        assert told[name]["sigma_tilt"] == pytest.approx(np.sqrt(np.trace(tilt)))
        assert poses[-1].sigma[s] == pytest.approx(np.sqrt(np.trace(tilt) + of_heading))
        if parents[s] >= 0:  # two accelerometers are off, and what both segments share does not count
            between = segments["P"][s] + segments["P"][parents[s]] - segments["C"][s] - segments["C"][s].T
            assert told[name]["heading"] == "observed"
            expected = share * np.trace(between[:3, :3]) + 4.0 * at_rest
            assert told[name]["sigma_relative"] == pytest.approx(np.sqrt(expected))


def test_tilts_of_modules_that_move_on_the_body_are_told_less_sure(frames):
    reconstructors = [JointReconstructor(CHAIN.suit, 1.0 / RATE_HZ) for _ in range(2)]
    rng = np.random.default_rng(3)
    loose = [
        replace(f, specific_force=f.specific_force + 2.0 * rng.standard_normal(f.specific_force.shape))
        for f in frames
    ]
    for reconstructor, seen in zip(reconstructors, (frames, loose), strict=True):
        update_many(reconstructor, seen)
    lasting = 2.0 * (tuning().force_bias / np.linalg.norm(CHAIN.suit.gravity)) ** 2
    firm, soft = (
        np.array([one["sigma_tilt"] ** 2 for one in r.certainty().values()]) - lasting for r in reconstructors
    )
    assert (soft > 4.0 * firm).all()


def seen(noise, n=400):
    """Return variance (rad²) and angle (rad) shown by n pairs at 100 Hz; the noise of each side, m/s²."""
    sums, rng = initial_state(2, 0).segments[1].heading_sums, np.random.default_rng(3)
    forget_evidence(sums)
    for _ in range(n):
        y = np.append(rng.normal(0.0, 2.0, 2), 9.81)
        u = from_rotation_vector(np.array([0.0, 0.0, -0.7])) @ y + rng.normal(0.0, noise, 3)
        gather_heading(sums, u, y, 1.0 * 0.1 / 0.01, 0.01 / 0.1, tuning(), 0.01)
    return shown_heading(sums, tuning())


def test_a_heading_is_shown_by_sides_that_fit_as_their_noise_lets_expect():
    variance, angle = seen(noise=1.0)
    assert 0.0 < variance < 0.1
    assert angle == pytest.approx(0.7, abs=0.15)


def test_sides_that_are_no_joint_show_none_however_long():
    """As of modules that are swapped: they agree a little, and differ by far more than any noise."""
    assert seen(noise=4.0) == (0.0, 0.0)
    assert seen(noise=4.0, n=4000) == (0.0, 0.0)


def test_sides_without_any_acceleration_show_none():
    sums = initial_state(2, 0).segments[1].heading_sums
    forget_evidence(sums)
    for _ in range(200):
        gather_heading(sums, np.zeros(3), np.array([0.5, 0.2, 9.81]), 1.0, 0.1, tuning(), 0.01)
    assert shown_heading(sums, tuning()) == (0.0, 0.0)
