"""Who has left a moment ago is known again by where they were lost, and by the lengths of the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gateway.cameras.returning_people import ReturningPeople, Somebody
from gateway.reconstruction.video.keypoint_set import KeypointSet, load_keypoint_set
from gateway.reconstruction.video.proportions import PARTS, sized, standard_lengths

KEYPOINTS = load_keypoint_set("blazepose_33")
HIDDEN = ("thigh", "shank", "foot", "hand", "head", "shoulders")
"""Parts that are measured badly while something stands before them."""


def person(size: float = 1.0, parts: tuple[str, ...] = PARTS) -> KeypointSet:
    """A body of which some parts are larger."""
    lengths = standard_lengths(KEYPOINTS) * np.where(np.isin(PARTS, parts), size, 1.0)
    skeleton, markers = sized(KEYPOINTS, lengths)
    return replace(KEYPOINTS, skeleton=skeleton, markers=markers)


def seen(body: KeypointSet, x: float, seconds: float) -> Somebody:
    return Somebody(body, np.array([x, 0.0, 0.9]), round(1e9 * seconds))


def number_of(newcomer: Somebody, **away: Somebody) -> int | None:
    returning = ReturningPeople()
    for name, somebody in away.items():
        returning.add(int(name.removeprefix("p")), somebody)
    back = returning.known_again(newcomer)
    return None if back is None else back[0]


@pytest.mark.parametrize(
    ("body", "x", "seconds", "number"),
    [
        (person(1.2, HIDDEN), 0.6, 1.0, 1),
        (person(1.2, HIDDEN), 2.5, 1.0, None),
        (person(1.2, HIDDEN), 0.6, 6.0, None),
        (person(0.9), 0.1, 1.0, None),  # another person in the same place
        (person(1.02), 2.5, 1.0, 1),  # ran
        (person(1.08), 2.5, 1.0, None),
        (person(1.02), 6.0, 1.0, None),
    ],
)
def test_who_comes_back_is_known_by_place_and_lengths(body, x, seconds, number):
    assert number_of(seen(body, x, seconds), p1=seen(person(), 0.0, 0.0)) == number


def test_of_two_who_were_lost_the_nearer_one_is_back_unless_both_are_as_near():
    lost = {"p1": seen(person(), 0.0, 0.0), "p2": seen(person(), 1.0, 0.0)}
    assert number_of(seen(person(1.2, HIDDEN), 0.1, 1.5), **lost) == 1
    assert number_of(seen(person(1.2, HIDDEN), 0.9, 1.5), **lost) == 2
    assert number_of(seen(person(1.2, HIDDEN), 0.5, 1.5), **lost) is None


def test_who_is_known_again_has_the_lengths_measured_before_and_is_away_no_more():
    returning = ReturningPeople()
    whole = person()
    returning.add(1, seen(whole, 0.0, 0.0))
    newcomer = seen(person(1.2, HIDDEN), 0.1, 1.0)
    assert returning.known_again(newcomer) == (1, whole)
    assert returning.known_again(newcomer) is None
