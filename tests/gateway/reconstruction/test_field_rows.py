"""What the field is believed: how far it is off throughout is found, and what comes and goes averages out."""

import numpy as np
import pytest

from gateway.emulation.fast_arm import fast_arm
from gateway.geometry.rotation_matrix import from_rotation_vector
from gateway.reconstruction.inertial.tree.headings import expect_field, field_row, watch_field
from gateway.reconstruction.inertial.tree.state import chain_body, initial_state, work_space
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.inertial.tree.update import clear

DT, N, SEGMENT = 0.05, 5, 2
BODY, TUNING = chain_body(fast_arm(), uses_field=True), tuning()


def watched(seconds, field_at, sigma, rate=0.0):
    """The segment; then the heading that the last row tells, rad, and how surely, 1/rad². The segment's
    heading is right, and known to sigma; rate: at which it is taken to turn, rad/s."""
    segment, work = initial_state(N, 1).segments[SEGMENT], work_space(N)
    now, expected = work.segments[SEGMENT], work.shared.expected
    segment.R[...], segment.rate[0] = np.eye(3), rate
    segment.field_offset.variance = TUNING.heading**2
    expect_field(expected, BODY.world, TUNING, DT)
    for k in range(round(seconds / DT)):
        segment.P[2, 2] = sigma**2
        clear(now.evidence)
        now.magnetic_field[...] = field_at(k * DT)
        watch_field(segment, now, BODY.world, expected, TUNING, DT)
        field_row(segment, BODY.segments[SEGMENT], now, expected, TUNING, DT)
    told = now.evidence.own[2, 2]
    return segment, now.evidence.own_vector[2] / told, told


def turned(angle):
    """The field as a building bends it, the same at all times."""
    field = from_rotation_vector(np.array([0.0, 0.0, angle])) @ BODY.world.magnetic_field
    return lambda _: field


def test_a_field_that_is_off_throughout_turns_nobody_whose_heading_is_known():
    _, at_first, _ = watched(DT, turned(0.1), 0.01)
    segment, at_last, _ = watched(60.0, turned(0.1), 0.01)
    assert abs(at_first) == pytest.approx(0.1, rel=0.01)
    assert abs(at_last) < 0.01
    assert segment.field_offset.angle == pytest.approx(-at_first, rel=0.1)
    assert 0.0 < segment.field_offset.variance < 0.1 * TUNING.heading**2


def test_it_leads_a_heading_that_nobody_knows():
    _, at_last, _ = watched(10.0, turned(0.1), 1.0)
    assert abs(at_last) == pytest.approx(0.1, rel=0.1)


def test_it_holds_a_heading_the_better_the_longer_it_stays_as_it_is():
    told = [watched(seconds, turned(0.1), 0.05)[2] for seconds in (5.0, 30.0, 120.0)]
    assert told[2] > told[1] > told[0]


def test_a_field_that_is_as_it_should_be_while_the_module_turns_is_believed():
    """How accelerometers tilt the module is left: 0.3° in a field that dips by 65°, 0.6° of heading."""
    still = watched(30.0, turned(0.0), 0.05)[0]
    moving = watched(30.0, turned(0.0), 0.05, rate=3.0)[0]
    sigma, sigma_still = (np.degrees(np.sqrt(s.field_offset.variance)) for s in (moving, still))
    assert sigma < 0.7
    assert sigma_still > 2.0


@pytest.mark.parametrize("wrong", [lambda h: 1.1 * h, lambda h: h * [1.0, 1.0, 0.8]])
def test_one_that_is_stronger_or_flatter_is_believed_no_more_than_before(wrong):
    still = watched(30.0, lambda _: wrong(BODY.world.magnetic_field), 0.05)[0]
    moving = watched(30.0, lambda _: wrong(BODY.world.magnetic_field), 0.05, rate=3.0)[0]
    assert moving.field_offset.variance == pytest.approx(still.field_offset.variance, rel=0.05)


def test_what_was_found_beside_it_before_it_was_proved_is_given_up():
    """A heading that the start had wrong by as much is not kept for ever: the field takes it back."""

    def right_from(seconds):
        return lambda t: turned(0.1)(t) * 1.2 if t < seconds else BODY.world.magnetic_field

    segment, _, _ = watched(120.0, right_from(20.0), 0.05, rate=3.0)
    assert abs(segment.field_offset.angle) < 0.01


def test_what_comes_and_goes_averages_out_and_what_lasts_does_not():
    def to_and_fro(period):
        return lambda t: BODY.world.magnetic_field * (1.0 + 0.05 * np.sign(np.sin(2.0 * np.pi * t / period)))

    fleeting, lasting = (watched(59.0, to_and_fro(period), 0.01)[2] for period in (0.4, 12.0))
    assert fleeting > 1.5 * lasting
