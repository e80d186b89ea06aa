"""The field beside the filter: what it turns, what it may not turn, and how the error is shared out."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.emulation.fast_arm import fast_arm, sampled
from gateway.emulation.random_chains import drawn
from gateway.geometry.rotation_matrix import from_rotation_vector
from gateway.reconstruction.inertial.tree import compass as kernels
from gateway.reconstruction.inertial.tree.reconstructor import JointReconstructor
from gateway.reconstruction.inertial.tree.start import start_compass
from gateway.reconstruction.inertial.tree.state import Heading, chain_body, initial_state, work_space
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.reconstructor import update_many

DT, SEGMENT = 0.05, 2
BODY, TUNING = chain_body(fast_arm(), uses_field=True), tuning()
N = len(BODY.segments)


def turned(angle):
    """The field as a building bends it, the same at all times."""
    field = from_rotation_vector(np.array([0.0, 0.0, angle])) @ BODY.world.magnetic_field
    return lambda _: field


def watched(seconds, field_at, rate=0.0, tilt_square=1e-6):
    """The compass of a level segment whose heading is right.

    rate: at which it is taken to turn, rad/s. tilt_square: rad² by which its tilt is taken to be uncertain.
    """
    segment, work = initial_state(N, 1).segments[SEGMENT], work_space(N)
    now, expected = work.segments[SEGMENT], work.shared.expected
    segment.R[...], segment.rate[0] = np.eye(3), rate
    segment.P[...] = np.diag([tilt_square, tilt_square, 1.0, 1e-4, 1e-4, 1e-4])
    start_compass(segment.compass, TUNING)
    now.density = TUNING.gyroscope**2
    kernels.expect_field(expected, BODY.world, TUNING, DT)
    for k in range(round(seconds / DT)):
        now.magnetic_field[...] = field_at(k * DT)
        kernels._drift(segment, now, TUNING, DT)
        kernels.watch_field(segment, now, BODY.world, expected, TUNING, DT)
        segment.compass.offset_square = segment.field_watch.error_square / expected.horizontal
        bent = tilt_square * (1.0 / expected.horizontal - 1.0)
        kernels._look(segment.compass, now, bent, TUNING, DT)
        segment.compass.tilt_square = segment.compass.misread**2 * bent
    return segment.compass


@pytest.mark.parametrize("angle", [-2.5, -0.1, 0.3, 3.0])
def test_a_compass_finds_by_what_the_heading_is_off(angle):
    compass = watched(20.0, turned(angle))
    assert compass.angle == pytest.approx(angle, abs=0.01)
    assert abs(compass.angle - angle) < 3.0 * np.sqrt(compass.variance)


def test_the_longer_it_looks_the_surer_it_is():
    variance = [watched(seconds, turned(0.1)).variance for seconds in (1.0, 5.0, 30.0)]
    assert variance[0] > variance[1] > variance[2]


def test_a_heading_that_drifts_is_followed_with_its_rate():
    drift = np.radians(0.3)
    compass = watched(60.0, lambda t: turned(drift * t)(t))
    assert compass.angle == pytest.approx(60.0 * drift, abs=np.radians(3.0))


def corrected(compass_misread, steps=20):
    """The compass of a segment that first looked with a tilt 0.4 rad wrong, once that has been corrected.

    Its heading is right; a step corrects the tilt by a share of its error.
    """
    segment, work = initial_state(N, 1).segments[SEGMENT], work_space(N)
    now, expected, wrong = work.segments[SEGMENT], work.shared.expected, np.array([-0.3, 0.25, 0.0])
    segment.R[...] = from_rotation_vector(wrong)
    segment.P[...] = np.diag([0.1, 0.1, 1.0, 1e-4, 1e-4, 1e-4])
    start_compass(segment.compass, TUNING)
    now.magnetic_field[...] = BODY.world.magnetic_field
    kernels.expect_field(expected, BODY.world, TUNING, DT)
    kernels.watch_field(segment, now, BODY.world, expected, TUNING, DT)
    kernels._look(segment.compass, now, 0.1, TUNING, DT)
    first = segment.compass.angle
    assert segment.compass.misread == 1.0
    segment.compass.misread = compass_misread
    for _ in range(steps):
        now.turn[...] = -wrong / steps
        now.rotation[...] = from_rotation_vector(now.turn)
        kernels.turn_compass(segment, now)
        segment.R[...] = now.rotation @ segment.R
    return first, segment.compass.angle


def test_a_first_look_with_a_wrong_tilt_is_right_once_the_tilt_is():
    first, angle = corrected(1.0)
    assert abs(np.degrees(first)) > 10.0
    assert angle == pytest.approx(0.0, abs=1e-9)


def test_looks_that_were_taken_with_many_tilts_stay_as_they_are_when_one_is_corrected():
    first, angle = corrected(0.0)
    assert angle == first


def test_looks_with_one_tilt_do_not_add_up_to_a_sure_heading():
    compass = watched(20.0, turned(0.0), tilt_square=0.05)
    assert compass.misread > 0.9
    assert compass.tilt_square > 10.0 * watched(20.0, turned(0.0)).variance


def test_a_field_that_scatters_tells_less_than_one_that_does_not():
    def scattered(t):
        return turned(0.5 * np.sin(7.0 * t))(t)

    assert watched(20.0, scattered).variance > 3.0 * watched(20.0, turned(0.0)).variance


def test_a_place_that_was_left_does_not_outweigh_what_is_seen_after_it():
    """As on a metal table, whose field is quiet and off by 2 rad, and in the hand."""

    def lifted(t):
        return turned(2.0 if t < 3.0 else 0.3 * np.sin(3.0 * t))(t)

    for seconds in (4.0, 13.0, 60.0):
        compass = watched(seconds, lifted, rate=1.0)
        assert abs(compass.angle) < 4.0 * np.sqrt(compass.variance)
    assert abs(compass.angle) < 0.5


def test_a_field_that_is_as_it_should_be_while_the_module_turns_is_believed():
    still, moving = (np.degrees(np.sqrt(watched(30.0, turned(0.0), w).offset_square)) for w in (0.0, 3.0))
    assert moving < 0.5
    assert still > 10.0


@pytest.mark.parametrize("wrong", [lambda h: 1.1 * h, lambda h: h * [1.0, 1.0, 0.8]])
def test_one_that_is_stronger_or_flatter_is_believed_no_more_for_turning(wrong):
    offset = np.sqrt(watched(30.0, lambda _: wrong(BODY.world.magnetic_field), 3.0).offset_square)
    assert np.degrees(offset) > 5.0


def draw_headings(rng, state, has_field):
    """Fill in started segments of any compasses, some of whose headings motion has not shown yet."""
    for s, segment in enumerate(state.segments):
        segment.started, segment.heading = kernels.STARTED, Heading.OBSERVED.value
        segment.P[2, 2] = rng.uniform(0.1, 0.2)
        segment.C[2, 2] = rng.uniform(0.0, 0.09)
        start_compass(segment.compass, TUNING)
        segment.compass.seconds = 1.0 if has_field and (rng.random() < 0.8 or s == 0) else 0.0
        segment.compass.angle = rng.normal(0.0, 0.3)
        segment.compass.error = rng.normal(0.0, 0.1)
        segment.compass.variance = rng.uniform(0.001, 0.1)
        segment.compass.offset_square = rng.uniform(0.0, 0.1)
        if s > 0 and rng.random() < 0.4:  # motion has shown something of it, or next to nothing
            sums, angle = segment.heading_sums, rng.normal(0.0, 0.3)
            segment.heading, kappa = Heading.UNOBSERVED.value, rng.choice([0.1, 3.0, 10.0])
            sums.along, sums.across = kappa * np.cos(angle), kappa * np.sin(angle)
            sums.length, sums.square, sums.expected = 1.2 * kappa, 2.4 * kappa, 10.0


@given(
    parents=st.lists(st.integers(0, 100), min_size=1, max_size=7),
    seed=st.integers(0, 2**32 - 1),
    has_field=st.booleans(),
    is_world_shown=st.booleans(),
)
def test_errors_are_shared_out_as_least_squares_over_the_tree(parents, seed, has_field, is_world_shown):
    """(32) beside one dense system; the root free to move at once."""
    rng = np.random.default_rng(seed)
    parents = [-1, *(p % (s + 1) for s, p in enumerate(parents))]
    n = len(parents)
    body, state, work = replace_parents(parents), initial_state(n, 0), work_space(n)
    body.segments[0].heading_observable = int(is_world_shown)
    draw_headings(rng, state, has_field)
    before = np.array([segment.compass.error for segment in state.segments])
    kernels.share_headings(body, state, TUNING, work, DT)

    compasses = [segment.compass for segment in state.segments]
    seen = np.array([c.seconds > 0.0 for c in compasses])
    apart = np.array([now.apart for now in work.segments])
    expected = np.array([now.expected for now in work.segments])
    for s, segment in enumerate(state.segments):
        if segment.heading == Heading.OBSERVED.value:
            assert expected[s] == 0.0
            continue
        kappa = np.hypot(segment.heading_sums.along, segment.heading_sums.across)
        psi = np.arctan2(segment.heading_sums.across, segment.heading_sums.along)
        assert expected[s] == pytest.approx(-psi * kappa**2 / (kappa**2 + TUNING.heading_noise**2))
        known = 1.0 / TUNING.unknown_heading**2 + kappa / TUNING.heading_density
        assert apart[s] == pytest.approx(1.0 / known)
    angle = np.array([now.unwrapped for now in work.segments])
    variance = kernels._compass_variance(body.segments, state.segments, work.segments, TUNING)
    assert has_field == (variance > 0.0)
    if has_field:
        counts = 1.0 / (1.0 + state.segments["compass"]["variance"] / TUNING.compass_clean**2)
        counts = counts / counts[seen].max()
        weight = np.where(seen, counts / (variance + (angle - before) ** 2), 0.0)
    else:  # what hangs together may turn as it does not know where it heads
        is_first = [segment.heading == Heading.UNOBSERVED.value for segment in state.segments]
        gives = state.segments["P"][:, 2, 2] ** 2 / TUNING.unknown_heading**2
        weight = np.where(is_first, 1.0 / gives, 0.0)
        angle = np.zeros(n)
    # the mean of all as the chain hangs together; then a root between that and the filter
    A, b = np.diag(weight), weight * angle
    row = np.array([1.0, -1.0])
    for s, p in enumerate(parents[1:], start=1):
        A[np.ix_([s, p], [s, p])] += np.outer(row, row) / apart[s]
        b[[s, p]] += row * expected[s] / apart[s]
    if has_field:
        spread = np.linalg.inv(A)
        share = apart[0] / (apart[0] + variance + spread[0, 0])
        root = share * (spread @ b)[0]
    else:
        root = np.linalg.solve(A + np.diag([1.0 / apart[0], *np.zeros(n - 1)]), b)[0]
    assert compasses[0].error == pytest.approx(root, abs=1e-12)
    if n > 1:  # given the root, the others
        rest = np.linalg.solve(A[1:, 1:], b[1:] - A[1:, 0] * compasses[0].error)
        np.testing.assert_allclose([c.error for c in compasses[1:]], rest, atol=1e-9)


def a_settled_body(n, is_world_shown=False):
    """A chain whose headings are known against each other, published where they are for long; work done."""
    body, state, work = replace_parents([-1, *range(n - 1)]), initial_state(n, 0), work_space(n)
    body.segments[0].heading_observable = int(is_world_shown)
    for s, segment in enumerate(state.segments):
        segment.started, segment.heading = kernels.STARTED, Heading.OBSERVED.value
        segment.P[2, 2], segment.C[2, 2] = 0.0101, 0.01
        start_compass(segment.compass, TUNING)
        compass = segment.compass
        compass.seconds, compass.settled_s, compass.error = 60.0, 60.0, 0.2
        compass.variance, compass.offset_square = 0.02, 0.5
        compass.angle = 0.2 + (0.8, -0.3, 0.4, 0.6)[s % 4]
    kernels.share_headings(body, state, TUNING, work, DT)
    return body, state, work


def published_errors(state):
    return np.array([segment.compass.error for segment in state.segments])


def test_a_root_that_is_lost_and_found_does_not_turn_the_body():
    """What was published turned with the root, and jumped as it was found again."""
    body, state, work = a_settled_body(4)
    before = published_errors(state)
    root = state.segments[0]
    root.P[2, 2], root.C[2, 2], root.compass.variance = 1.0, 0.0, 1.0
    for _ in range(100):
        kernels.share_headings(body, state, TUNING, work, DT)
    np.testing.assert_allclose(published_errors(state)[1:].mean(), before[1:].mean(), atol=0.01)
    root.P[2, 2], root.compass.angle, work.segments[0].compass_turn = 0.0101, root.compass.angle - 1.2, -1.2
    kernels.share_headings(body, state, TUNING, work, DT)
    work.segments[0].compass_turn = 0.0
    np.testing.assert_allclose(published_errors(state)[1:].mean(), before[1:].mean(), atol=0.02)


def test_a_body_whose_heading_a_device_shows_heads_as_it_did_while_its_root_is_lost():
    """Nothing held the others but compasses that were wrong: a ring went 50° aside."""
    body, state, work = a_settled_body(4, is_world_shown=True)
    before = published_errors(state)
    root, child = state.segments[0], state.segments[1]
    root.heading, root.P[2, 2], child.C[2, 2] = Heading.UNOBSERVED.value, TUNING.unknown_heading**2, 0.0
    root.compass.variance = 1.0
    for _ in range(100):
        root.compass.angle += 0.02
        kernels.share_headings(body, state, TUNING, work, DT)
    np.testing.assert_allclose(published_errors(state)[1:], before[1:], atol=0.02)
    assert state.segments[1].compass.error_variance < 0.02


def turned_at_once(unseen_square, wanted, variance, instants=200):
    """How far a body turns within two seconds to compasses that are so far off, in radians."""
    compass = initial_state(N, 1).segments[SEGMENT].compass
    start_compass(compass, TUNING)
    compass.settled_s, compass.rate_variance, turned = 100.0, 0.0, 0.0
    for k in range(instants):
        unseen = unseen_square if k == 0 else 0.0
        turned += kernels._limited_turn(compass, wanted - turned, variance, unseen, TUNING, 0.01)
    return turned


@given(st.floats(0.01, 1.5), st.floats(-1.0, 1.0), st.floats(0.01, 1.0))
def test_of_what_it_turned_unseen_a_body_believes_its_compasses_once(unseen, wanted, sigma):
    """The same field, seen again and again, once turned it all the way."""
    turned = turned_at_once(unseen**2, wanted, sigma**2)
    most = wanted * unseen**2 / (unseen**2 + sigma**2)
    slowly = abs(wanted) * 2.0 / TUNING.compass_finds_s + 1e-12
    assert min(most, 0.0) - slowly <= turned <= max(most, 0.0) + slowly
    assert abs(turned) >= 0.9 * abs(most) - 1e-12


def test_without_anything_unseen_a_body_turns_to_its_compasses_slowly():
    assert abs(turned_at_once(0.0, 1.0, 0.1**2)) < 0.04


def test_a_whole_turn_of_one_compass_is_none():
    """The compass of a segment that was lost made all others seem a whole turn off."""
    body, state, work = a_settled_body(4)
    before = published_errors(state)
    state.segments[0].compass.angle += 2.0 * np.pi
    kernels.share_headings(body, state, TUNING, work, DT)
    within = np.angle(np.exp(1j * (published_errors(state) - before)))
    np.testing.assert_allclose(within, 0.0, atol=1e-3)


def replace_parents(parents):
    """A body whose segments have these parents."""
    body = chain_body(drawn(5001).suit, uses_field=True)
    segments = np.zeros(len(parents), body.segments.dtype).view(type(body.segments))
    segments["parent"] = parents
    return body._replace(segments=segments)


CHAIN = drawn(5001)


def poses(method, bend=None, uses=True):
    """The filter's orientations and the poses of a chain in a field that ``bend(t, segment)`` turns."""
    frames = sampled(CHAIN.suit, CHAIN.motion, CHAIN.switches, CHAIN.seed, 100.0)[:1500]
    if bend is not None:
        frames = [replace(f, magnetic_field=bend(f)) for f in frames]
    reconstructor = method(CHAIN.suit, 0.01)
    found = update_many(reconstructor, frames)
    return reconstructor, found


def test_no_field_reaches_the_filter_once_headings_are_shown():
    """Iron that comes near turns what is published, never what motion has shown."""

    def bend(frame):
        return frame.magnetic_field * 1.4 if frame.time_ns > 8e9 else frame.magnetic_field

    plain, _ = poses(JointReconstructor)
    bent, _ = poses(JointReconstructor, bend)
    assert (plain.state()["segments"]["compass"] != bent.state()["segments"]["compass"]).any()
    for one, other in zip(plain._state.segments, bent._state.segments, strict=True):
        assert one.heading == Heading.OBSERVED.value or one is plain._state.segments[0]
        np.testing.assert_array_equal(one.R, other.R)
        np.testing.assert_array_equal(one.P, other.P)
        np.testing.assert_array_equal(one.bias, other.bias)


def test_iron_beside_one_module_does_not_turn_it_against_its_neighbours():
    """A quarter of a turn on one module, after its heading was shown by motion."""
    turn = from_rotation_vector(np.array([0.0, 0.0, np.pi / 2]))

    def bend(frame):
        m = frame.magnetic_field.copy()
        if frame.time_ns > 8e9:
            m[1] = turn @ m[1]
        return m

    _, plain = poses(JointReconstructor)
    _, bent = poses(JointReconstructor, bend)
    apart = [
        2.0 * np.degrees(np.arccos(np.clip(np.abs(np.sum(a.q_wb * b.q_wb, axis=1)), 0.0, 1.0)))
        for a, b in zip(plain, bent, strict=True)
    ]
    assert np.nanmax(apart) < 3.0
