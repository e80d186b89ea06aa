"""Pressure tubes against the equation they stand on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.sources.air_velocity import air_velocity


@given(v=st.lists(st.floats(-40, 40), min_size=3, max_size=3), celsius=st.floats(-40, 45))
def test_velocity_is_found_again(v, celsius):
    density = 101_325.0 / (287.05 * (celsius + 273.15))
    pressure = tuple(0.5 * density * x * abs(x) for x in v)
    found, sigma = air_velocity(pressure, 101_325.0, celsius)
    assert np.allclose(found, v, rtol=1e-9, atol=1e-9)
    assert (sigma > 0).all()


def test_slow_motion_is_known_worse():
    _, sigma = air_velocity((60.0, 0.6, 0.0), 101_325.0, 15.0)
    assert sigma[0] == pytest.approx(0.2 / (1.225 * 9.9), rel=0.01)
    assert sigma[0] < sigma[1] < sigma[2] == pytest.approx(np.sqrt(2 * 0.2 / 1.225), rel=0.01)


def test_temperature_that_is_not_told_is_the_usual_one():
    assert air_velocity((6.0, 0.0, 0.0), 1e5, None)[0][0] == air_velocity((6.0, 0.0, 0.0), 1e5, 15.0)[0][0]


@pytest.mark.parametrize(("static", "celsius"), [(0.0, 15.0), (2e5, 15.0), (1e5, -120.0)])
def test_air_that_nobody_breathes_is_a_damaged_reading(static, celsius):
    assert np.isnan(air_velocity((1.0, 1.0, 1.0), static, celsius)[0]).all()
