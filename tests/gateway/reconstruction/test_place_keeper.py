"""Where the body is while nobody measures it, and after."""

import numpy as np

from gateway.reconstruction.inertial.local_devices import RETURN_S, PlaceKeeper

NONE = np.full(3, np.nan)


def test_without_any_measurement_there_is_no_place():
    assert np.isnan(PlaceKeeper().at(NONE, 0)).all()


def test_place_follows_what_is_measured():
    keeper = PlaceKeeper()
    places = [keeper.at(np.full(3, 0.1 * k), k * 10_000_000) for k in range(20)]
    assert np.allclose(places, [np.full(3, 0.1 * k) for k in range(20)])


def test_it_stands_still_while_silent_and_glides_back():
    keeper, ms = PlaceKeeper(), 1_000_000
    keeper.at(np.zeros(3), 0)
    assert (keeper.at(NONE, 500 * ms) == 0.0).all()
    there = np.array([2.0, 0.0, 0.0])
    way = np.array([keeper.at(there, (1000 + 10 * k) * ms)[0] for k in range(400)])
    assert way[0] == 0.0
    assert (np.diff(way) > 0.0).all()
    assert np.max(np.diff(way)) < 1.05 * 2.0 * 0.01 / RETURN_S
    assert abs(way[-1] - 2.0) < 0.01
