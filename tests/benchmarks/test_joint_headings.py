"""Headings by accelerations at the joints, of emulated walking: what a reference is turned by is found."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import trackers
from benchmarks.joint_headings import heading_errors


@pytest.fixture(scope="module")
def walking():
    return next(trackers.motions())


def test_a_reference_that_is_true_is_believed(walking):
    errors = heading_errors(walking.suit, walking.rate_hz, walking.force, walking.q_wb)
    assert np.degrees(np.abs(errors)).max() < 1.5


def test_what_a_reference_is_turned_by_is_found_beside_gaps(walking):
    turns = np.radians([0.0, 17.0, -9.0, 4.0, 0.0, -25.0, 12.0])
    half = 0.5 * turns
    turned = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    q_wb = trackers._product(np.broadcast_to(turned, walking.q_wb.shape), walking.q_wb)
    q_wb[1000:1200, 3] = np.nan
    errors = heading_errors(walking.suit, walking.rate_hz, walking.force, q_wb)
    assert np.degrees(np.abs(errors - (turns - turns.mean()))).max() < 2.0
