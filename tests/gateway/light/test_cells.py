"""The cell solver against readings made from a known light."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gateway.sources.light import CellArray

FACES = np.vstack([[axis, -axis] for axis in np.eye(3)])
SLANTED = np.array([[1, 0, 0.3], [-1, 0.2, 0.3], [0, 1, 0.3], [0.1, -1, 0.3], [0, 0, 1], [0.2, 0.1, -1.0]])

angle = st.floats(-np.pi, np.pi)
height = st.floats(-1.0, 1.0)


def read(normals, direction, direct, diffuse):
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return direct * np.maximum(unit @ direction, 0.0) + diffuse


def unit_vector(around, up):
    flat = np.sqrt(1.0 - up * up)
    return np.array([flat * np.cos(around), flat * np.sin(around), up])


@pytest.mark.parametrize("normals", [FACES, SLANTED], ids=["faces", "slanted"])
@given(around=angle, up=height, direct=st.floats(0.05, 0.9), diffuse=st.floats(0.0, 0.3))
def test_light_that_fits_the_model_is_found(normals, around, up, direct, diffuse):
    direction = unit_vector(around, up)
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    lit = unit[unit @ direction > 0.05]
    if normals is SLANTED:
        assume(len(lit) >= 3 and np.linalg.svd(lit)[1][2] > 0.3)
        assume(np.abs(unit @ direction).min() > 0.05)
    found = CellArray(normals).solve(read(normals, direction, direct, diffuse))
    assert np.linalg.norm(found.direction - direction) < 1e-6
    assert found.direct == pytest.approx(direct)
    assert found.diffuse == pytest.approx(diffuse, abs=1e-9)
    assert found.residual < 1e-9


def test_even_light_has_no_direction():
    found = CellArray(FACES).solve(np.full(6, 0.2))
    assert found.direct < 1e-9
    assert found.diffuse == pytest.approx(0.2)


def test_a_shadow_on_some_cells_shows_in_the_residual():
    readings = read(FACES, unit_vector(0.7, 0.5), 0.6, 0.1)
    readings[0] = 0.0  # darker than diffuse light alone
    readings[2] = 0.9
    assert CellArray(FACES).solve(readings).residual > 0.02


def test_cells_in_one_plane_are_refused():
    with pytest.raises(ValueError, match="span"):
        CellArray(FACES[[0, 1, 2, 3]])
