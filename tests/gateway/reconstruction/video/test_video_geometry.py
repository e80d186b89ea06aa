"""Rays, lattices and the low-pass against closed form."""

import numpy as np
import pytest

from gateway.body.camera import project
from gateway.emulation.video_truth import ring_of_cameras
from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video import initial, lattice
from gateway.reconstruction.video.low_pass import DELAY, LowPass
from gateway.reconstruction.video.projection import camera_model, pixel, ray, undistorted

pytestmark = pytest.mark.timeout(600)  # whichever test comes first compiles

CAMERAS = ring_of_cameras(4)
MODELS = [camera_model(camera) for camera in CAMERAS]
MAP = np.array([[0.06, 0.0, 0.0], [0.0, 0.06, 6.0]])
"""Pixels of the ring's cameras to cells: all of the picture in 80 columns and 128 rows."""


def maps_of(camera, points, spread=2.0):
    """One blob a keypoint."""
    cells = project(camera, points) @ MAP[:, :2].T + MAP[:, 2]
    rows, columns = np.mgrid[0:128, 0:80]
    square = (columns - cells[:, 0, None, None]) ** 2 + (rows - cells[:, 1, None, None]) ** 2
    return CameraHeatMaps(np.exp(-0.5 * square / spread**2).astype(np.float32), MAP)


def test_a_kernel_projects_as_the_camera_does_and_a_ray_goes_back():
    points = np.random.default_rng(1).uniform(-0.8, 0.8, (30, 3)) + np.array([0, 0, 0.9])
    for camera, model in zip(CAMERAS, MODELS, strict=True):
        expected = project(camera, points)
        for point, (u, v) in zip(points, expected, strict=True):
            seen = camera.rotation @ point + camera.translation
            np.testing.assert_allclose(pixel(model, *seen), (u, v), atol=1e-9)
            np.testing.assert_allclose(undistorted(model, u, v), seen[:2] / seen[2], atol=1e-9)
            along = point - camera.position
            np.testing.assert_allclose(ray(model, u, v), along / np.linalg.norm(along), atol=1e-9)


def test_nothing_is_seen_behind_a_camera():
    assert np.isnan(pixel(MODELS[0], 0.1, 0.1, -1.0)).all()


def test_maps_are_linear_between_cells_and_zero_outside():
    values = (np.arange(6)[:, None] * 3.0 + np.arange(7)).astype(np.float32)
    for column, row in ((1.25, 2.5), (3.9, 3.1), (2.0, 4.0)):
        for sample in (lattice.bilinear, lattice.smooth):
            assert sample(values, column, row) == pytest.approx(3.0 * row + column, abs=1e-5)
    for column, row in ((-0.1, 2.0), (6.1, 2.0), (2.0, 5.2), (np.nan, 1.0)):
        assert lattice.bilinear(values, column, row) == lattice.smooth(values, column, row) == 0.0


def test_lattices_close_in_on_a_keypoint():
    points = np.array([[0.10, -0.20, 1.20], [-0.30, 0.10, 0.60], [np.nan] * 3])
    centres, found = points + np.array([0.06, -0.05, 0.04]), None
    for s, is_fine in ((0.020, False), (0.004, True)):
        total, spacing = np.zeros((3, 11**3)), np.full(3, s)
        for camera, model in zip(CAMERAS, MODELS, strict=True):
            maps = maps_of(camera, np.nan_to_num(points))
            view = lattice.View(model, maps.likelihood, maps.map_from_pixel)
            lattice.add_likelihood(total, view, lattice.Lattices(centres, spacing, 5), is_fine)
        found, likelihood = lattice.best_points(total, centres, spacing, 5)
        centres = found
    np.testing.assert_allclose(found[:2], points[:2], atol=0.005)
    assert likelihood[0] > 3.0
    assert np.isnan(found[2]).all()
    assert likelihood[2] == 0.0


def test_first_positions_come_from_rays():
    points = np.random.default_rng(2).uniform(-0.4, 0.4, (12, 3)) + np.array([0, 0, 1.0])
    maps = [maps_of(camera, points) for camera in CAMERAS]
    found, likelihood = initial.from_rays(MODELS, maps)
    known = np.isfinite(found[:, 0])
    assert known.sum() >= 9
    assert np.linalg.norm(found[known] - points[known], axis=1).max() < 0.1
    assert likelihood.min() > 2.0
    wanted = np.ones(len(points), dtype=bool)
    cells, _ = initial.from_volume(MODELS, maps, np.array([0.0, 0.0, 1.0]), 0.6, 0.05, wanted)
    assert np.linalg.norm(cells - points, axis=1).max() < 0.05


def test_rays_that_pass_each_other_further_than_20_mm_meet_nowhere():
    positions = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    directions = np.array([[0.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]) / [[1.0], [np.sqrt(2.0)]]
    sure = np.ones(2)
    near, far = np.array([[0, 0, 0], [0, 0, 0.018]]), np.array([[0, 0, 0], [0, 0, 0.022]])
    point, apart = initial.closest_pair(positions + near, directions, sure, 0.02)
    np.testing.assert_allclose(point, [0.0, 1.0, 0.009], atol=1e-12)
    assert apart == pytest.approx(0.018)
    point, _ = initial.closest_pair(positions + far, directions, sure, 0.02)
    assert np.isnan(point).all()
    backwards = initial.closest_pair(positions, -directions, sure, 0.02)[0]
    assert np.isnan(backwards).all()
    assert np.isnan(initial.nearest_to_rays(positions, directions, np.array([1.0, 0.0]))).all()


def test_a_bystander_is_outside_the_gate():
    points = np.random.default_rng(3).normal(0.0, 0.3, (20, 3))
    points[4] = [2.0, 0.0, 0.0]
    kept = initial.within_person(points)
    assert np.isnan(kept[4]).all()
    assert np.isfinite(np.delete(kept, 4, axis=0)).all()


def test_the_low_pass_is_three_frames_late_and_begins_at_rest():
    filtered, times = LowPass(), np.arange(120.0)
    ramp = np.array([filtered.add(np.array([[5.0 + 0.1 * t, -t]])) for t in times])[:, 0]
    np.testing.assert_allclose(ramp[60:, 0], 5.0 + 0.1 * (times[60:] - DELAY), atol=1e-6)
    filtered.reset()
    still = [filtered.add(np.array([2.0]))[0] for _ in range(20)]
    np.testing.assert_allclose(still, 2.0, atol=1e-9)
    filtered.reset()
    noise = [filtered.add(np.array([(-1.0) ** t]))[0] for t in range(80)]
    assert np.abs(noise[60:]).max() < 1e-3
