"""Crops for the networks, regions from heat maps, and what is drawn on pictures: all to the half pixel."""

import numpy as np
import pytest

pytest.importorskip("cv2")

from devices.cameras.heat_map_messages import HeatMapMessage
from gateway.cameras.overlay import draw_heat_maps, side_by_side
from gateway.cli.video import named, offsets_of
from gateway.errors import GatewayError
from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video.networks.cropping import cropped, shrunk_map
from gateway.reconstruction.video.networks.keypoints import BLAZEPOSE
from gateway.reconstruction.video.region import (
    ROLL_STEP,
    PersonRegion,
    peaks,
    region_of_points,
    upright_region,
)
from gateway.sources.heat_maps import heat_maps_of


def blob(x, y, spread, shape=(600, 800)):
    """A picture with a bright spot about (x, y)."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    grey = 255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * spread**2))
    return np.repeat(np.rint(grey).astype(np.uint8)[:, :, None], 3, axis=2)


def centre_of(picture):
    weights = picture[:, :, 0].astype(float)
    rows, columns = np.mgrid[: weights.shape[0], : weights.shape[1]]
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


@pytest.mark.parametrize("size", [100.0, 256.0, 500.0, 700.0, 1100.0])
@pytest.mark.parametrize("turns", [0, 1, -2, 5])
def test_a_spot_is_in_the_crop_where_the_affine_says(size, turns):
    """Also where the crop is shrunk by averaging first: that must not shift it by half a block."""
    region = PersonRegion(np.array([401.3, 296.8]), size, turns * ROLL_STEP)
    spot = np.array([401.3, 296.8]) + 0.11 * size * np.array([1.0, -0.6])
    affine = region.affine(256)
    crop = cropped(blob(*spot, size / 40), affine, 256)
    assert crop.shape == (256, 256, 3)
    assert centre_of(crop) == pytest.approx(affine[:, :2] @ spot + affine[:, 2], abs=0.12)


def test_cells_of_middles_and_of_edges():
    to_crop = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    middle, edge = (shrunk_map(to_crop, 4, of_edge=each) for each in (False, True))
    # pixels 0 to 3 are cell 0: their middle is at 1.5, their edge at -0.5
    assert middle @ [1.5, 1.5, 1] == pytest.approx([0, 0])
    assert edge @ [-0.5, -0.5, 1] == pytest.approx([0, 0])


def test_peaks_come_back_to_the_pixels_they_stand_for():
    region = PersonRegion(np.array([300.0, 250.0]), 400.0, 2 * ROLL_STEP)
    affine = shrunk_map(region.affine(256), 4, of_edge=True)
    likelihood = np.zeros((2, 64, 64), dtype=np.float32)
    likelihood[0, 20, 40], likelihood[1, 50, 9] = 0.9, 0.5
    places, likely = peaks(CameraHeatMaps(likelihood, affine))
    assert places @ affine[:, :2].T + affine[:, 2] == pytest.approx(np.array([[40.0, 20.0], [9.0, 50.0]]))
    assert likely == pytest.approx([0.9, 0.5])


@pytest.mark.parametrize("lean", np.radians([0, 14, 16, 44, 89, -100, 179]))
def test_the_trunk_stands_upright_within_half_a_step(lean):
    hips = np.array([300.0, 300.0])
    shoulders = hips + 100 * np.array([np.sin(lean), -np.cos(lean)])
    region = upright_region(hips, shoulders, 220.0)
    affine = region.affine(256)
    trunk = affine[:, :2] @ (shoulders - hips)
    assert abs(np.arctan2(trunk[0], -trunk[1])) <= ROLL_STEP / 2 + 1e-9
    assert affine @ [300, 300, 1] == pytest.approx([127.5, 127.5])


def test_a_region_needs_a_trunk_and_holds_all_that_is_likely():
    points = np.full((33, 2), np.nan)
    likelihood = np.zeros(33)
    for name, place in {"left_hip": (290, 300), "right_hip": (310, 300), "left_shoulder": (280, 200),
                        "right_shoulder": (320, 200), "left_ankle": (290, 480), "left_wrist": (200, 250),
                        "right_wrist": (400, 100)}.items():  # fmt: skip
        points[BLAZEPOSE.index(name)], likelihood[BLAZEPOSE.index(name)] = place, 0.8
    region = region_of_points(points, likelihood, BLAZEPOSE)
    assert region.centre == pytest.approx([300, 300])
    assert region.size / 2 > np.hypot(100, 200)
    likelihood[[BLAZEPOSE.index("left_hip"), BLAZEPOSE.index("right_hip")]] = 0.1
    assert region_of_points(points, likelihood, BLAZEPOSE) is None


def test_heat_maps_glow_where_they_are():
    picture = np.full((600, 800, 3), 60, dtype=np.uint8)
    region = PersonRegion(np.array([400.0, 300.0]), 400.0, ROLL_STEP)
    likelihood = np.zeros((1, 64, 64), dtype=np.float32)
    likelihood[0, 9:12, 29:32] = 1.0
    maps = CameraHeatMaps(likelihood, shrunk_map(region.affine(256), 4, of_edge=False))
    drawn = draw_heat_maps(picture, maps)
    changed = np.abs(drawn.astype(int) - picture).sum(axis=2)
    place = peaks(CameraHeatMaps(np.roll(likelihood, 0), maps.map_from_pixel))[0][0]
    rows, columns = np.nonzero(changed > 100)
    assert np.hypot(columns.mean() - place[0], rows.mean() - place[1]) < 15
    assert (drawn[:100] == 60).all()
    assert heat_maps_of(HeatMapMessage("a", "full", 0, 0, None, np.zeros((2, 3)))) is None


def test_pictures_stand_side_by_side_with_even_sides():
    pictures = [np.zeros((100, 51, 3), np.uint8), np.zeros((300, 200, 3), np.uint8)]
    row = side_by_side(pictures, ["a", "b"], 151, "walk_2  picture 812")
    written = np.flatnonzero(row[-30:].any(axis=(0, 2)))
    assert written.max() > 78, "the caption goes on below the second camera"
    assert row.shape[0] % 2 == row.shape[1] % 2 == 0


def test_files_find_their_cameras_by_name_by_word_and_by_order(tmp_path):
    known = ["cam1", "cam10", "left"]
    assert named(["walk_cam10.mp4", "x/cam1.avi"], known, tmp_path) == {
        "cam1": "x/cam1.avi",
        "cam10": "walk_cam10.mp4",
    }
    assert named(["left=a.mp4", "cam1=b.mp4"], known, tmp_path) == {"cam1": "b.mp4", "left": "a.mp4"}
    assert list(named(["a.mp4", "b.mp4", "c.mp4"], known, tmp_path).values()) == ["a.mp4", "b.mp4", "c.mp4"]


@pytest.mark.parametrize(
    ("places", "told"),
    [(["a.mp4"], "do not tell which cameras"), (["a", "b", "c", "d"], "4 cameras are given, and")],
)
def test_files_of_unknown_cameras_are_refused(tmp_path, places, told):
    with pytest.raises(GatewayError, match=told):
        named(places, ["cam1", "cam2", "cam3"], tmp_path)


@pytest.mark.parametrize("text", ["cam1", "cam1=-3", "cam9=3", "cam1=x"])
def test_an_offset_that_is_none_is_refused(text):
    assert offsets_of(["cam1=3"], ["cam1"]) == {"cam1": 3}
    with pytest.raises(GatewayError, match="--offset"):
        offsets_of([text], ["cam1"])
