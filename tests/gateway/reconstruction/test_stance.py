"""Rest of segments: what passes the test, what does not, and when it says so."""

from __future__ import annotations

import numpy as np
import pytest

from gateway.reconstruction.inertial.contacts import initial_stance, watch_stance
from gateway.reconstruction.inertial.observations import SegmentObservations

G = 9.81


def watch(force, rate, rate_hz=100, carries=1.0, status=None):
    """(n,) seconds at rest of one segment."""
    state = initial_stance(1)
    status = np.zeros(len(force), np.uint8) if status is None else np.asarray(status, np.uint8)
    found = np.zeros((len(force), 1))
    inputs = zip(np.asarray(force, float), np.asarray(rate, float), status, strict=True)
    for stood_s, (f, w, s) in zip(found, inputs, strict=True):
        observed = SegmentObservations(f[None], w[None], f[None], s[None], s[None])
        watch_stance(stood_s, state, np.array([carries]), G, observed, 1.0 / rate_hz)
    return found[:, 0]


def still(n, direction=(0.0, 0.6, 0.8), seed=1):
    """Specific force and rate of a segment at rest, of whatever orientation."""
    rng = np.random.default_rng(seed)
    return G * np.array(direction) + rng.normal(0, 0.05, (n, 3)), rng.normal(0, 0.005, (n, 3))


@pytest.mark.parametrize("rate_hz", [40, 60, 100, 200, 400])
@pytest.mark.parametrize("direction", [(0, 0, 1), (1, 0, 0), (0.0, -0.6, 0.8)])
def test_rest_is_found_within_50_ms_and_lasts(rate_hz, direction):
    stood_s = watch(*still(rate_hz, direction), rate_hz)
    first = np.flatnonzero(stood_s)[0]
    assert first / rate_hz <= 0.05
    assert (stood_s[first:] > 0).all()
    assert stood_s[-1] == pytest.approx(1.0 - first / rate_hz, abs=0.01)


MOTIONS = {
    "turning about its vertical, without acceleration": lambda t: (
        np.tile([0, 0, G], (len(t), 1)),
        np.tile([0, 0, 2.0], (len(t), 1)),
    ),
    "shaken by 12 m/s² to and fro": lambda t: (
        np.stack([12.0 * np.sin(20 * t + 0.4), 0 * t, G + 0 * t], axis=1),
        np.zeros((len(t), 3)),
    ),
    "accelerated evenly upwards": lambda t: (np.tile([0, 0, G + 3.0], (len(t), 1)), np.zeros((len(t), 3))),
    "falling": lambda t: (np.zeros((len(t), 3)), np.zeros((len(t), 3))),
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_motion_is_no_rest(motion):
    assert not watch(*MOTIONS[motion](np.arange(200) / 100.0)).any()


def test_rest_ends_within_50_ms_of_a_swing():
    force, rate = still(200)
    rate[100:] += np.array([0, 0, 5.0])
    stood_s = watch(force, rate)
    assert stood_s[99] > 0
    assert not stood_s[105:].any()


def test_a_wobble_between_the_thresholds_neither_begins_nor_ends_rest():
    force, rate = still(300)
    wobble = np.array([0, 0, 0.5 * np.sqrt(8.0)])
    rate[100:200] += wobble
    assert (watch(force, rate)[10:] > 0).all()
    rate[:100] += wobble
    assert not watch(force, rate)[:195].any()


def test_segments_that_carry_nothing_must_be_still_for_longer():
    stood_s = watch(*still(200), carries=0.0)
    assert np.flatnonzero(stood_s)[0] == pytest.approx(72, abs=5)


@pytest.mark.parametrize("status", [2, 3, 5])
def test_a_module_that_is_held_or_silent_shows_no_rest(status):
    codes = np.zeros(100)
    codes[50:70] = status
    stood_s = watch(*still(100), status=codes)
    assert not stood_s[50:70].any()
    assert stood_s[49] > 0
    assert stood_s[80] > 0


def test_values_that_are_no_numbers_show_no_rest():
    force, rate = still(100)
    force[50:60] = np.nan
    stood_s = watch(force, rate)
    assert not stood_s[50:60].any()
    assert np.isfinite(stood_s).all()
