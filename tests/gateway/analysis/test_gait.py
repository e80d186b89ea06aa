"""Strikes and lifts of feet by the floor's force."""

from __future__ import annotations

import numpy as np

from gateway.analysis.floor import FloorForces, ForceSource
from gateway.analysis.gait import gait_events
from gateway.body.body_file import load_body

BODY = load_body("human_17")
FEET = np.array([BODY.index("left_foot"), BODY.index("right_foot")])
TIME_S = 0.01 * np.arange(300)


def _floor(
    loads: list[list[tuple[int, int]]], unknown: list[list[tuple[int, int]]] | None = None
) -> FloorForces:
    """Loads of 700 N over frames, by foot; then unknown ones."""
    force, source = np.zeros((300, 2, 3)), np.zeros((300, 2), dtype=np.uint8)
    for c, spans in enumerate(loads):
        for first, last in spans:
            force[first : last + 1, c, 2] = 700.0
            source[first : last + 1, c] = ForceSource.MEASURED
    for c, spans in enumerate(unknown or [[], []]):
        for first, last in spans:
            source[first : last + 1, c] = ForceSource.UNKNOWN
    return FloorForces(FEET, force, np.zeros_like(force), source, np.zeros((300, 2)))


def test_feet_come_down_and_lift_off_in_turn():
    events = gait_events(BODY, _floor([[(0, 80), (150, 240)], [(70, 160), (230, 299)]]), TIME_S)
    assert [(round(e.time_s, 2), e.foot, e.event) for e in events] == [
        (0.7, "right_foot", "strike"),
        (0.8, "left_foot", "off"),
        (1.5, "left_foot", "strike"),
        (1.6, "right_foot", "off"),
        (2.3, "right_foot", "strike"),
        (2.4, "left_foot", "off"),
    ]
    assert {e.source for e in events} == {"measured"}


def test_short_breaks_and_short_loads_are_noise():
    events = gait_events(BODY, _floor([[(50, 90), (95, 150), (200, 204)], []]), TIME_S)
    assert [(round(e.time_s, 2), e.event) for e in events] == [(0.5, "strike"), (1.5, "off")]


def test_what_is_not_known_before_a_load_is_no_strike():
    events = gait_events(BODY, _floor([[(100, 150)], []], [[(60, 99)], []]), TIME_S)
    assert [(round(e.time_s, 2), e.event) for e in events] == [(1.5, "off")]


def test_who_never_touches_the_floor_has_no_events():
    assert gait_events(BODY, _floor([[], []]), TIME_S) == []
