"""The networks on real pictures. Their weights are no part of the project: without them these are skipped."""

import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("ai_edge_litert")

from devices.cameras.pictures import open_pictures
from devices.marker_files import read_markers
from gateway.body.camera import project
from gateway.calibration.cameras_file import load_cameras
from gateway.calibration.picture_size import SizeChange, fitted
from gateway.cameras.people_follower import follower_of
from gateway.errors import GatewayError
from gateway.reconstruction.video.networks.person_detector import PersonDetector
from gateway.reconstruction.video.networks.weights import load_network
from gateway.reconstruction.video.region import PersonRegion, peaks

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[4] / "shared" / "data")) / "pose2sim_single"

pytestmark = [
    pytest.mark.slow(reason="networks of 3 to 200 MB, which who wants them fetches"),
    pytest.mark.skipif(not DATA.is_dir(), reason="the recordings of shared/data are not here"),
]


def network(name):
    try:
        return load_network(name, 2)
    except GatewayError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def picture():
    return next(iter(open_pictures(str(DATA / "videos" / "cam03.mp4"))))[1]


@pytest.fixture(scope="module")
def region(picture):
    network("full")
    return PersonDetector(2).people(picture)[0].region


def test_the_walker_is_found_in_every_camera():
    """Where another program has the hips in the first picture, to an eighth of the person's height."""
    network("full")
    trial = read_markers(DATA / "reference" / "ref_0-100.trc")
    hips = trial.positions[0, [trial.labels.index(name) for name in ("RHip", "LHip")]].mean(axis=0)
    for camera in load_cameras(DATA / "calibration" / "Calib.qca.txt"):
        source = open_pictures(str(DATA / "videos" / f"{camera.name}.mp4"))
        person = PersonDetector(2).people(next(iter(source))[1])[0]
        seen_by = fitted(camera, source.info.width, source.info.height, SizeChange.SCALED)
        assert np.linalg.norm(person.hips - project(seen_by, hips[[2, 0, 1]])) < 0.25 * person.radius


def test_who_comes_beside_somebody_known_is_found_and_nobody_twice(picture):
    network("full")
    detector = PersonDetector(2)
    known = detector.people(picture)[0]
    twice = picture.copy()
    twice[:, :440] = picture[:, 400:840]  # the walker once more, on the left
    for shown, wanted in ((picture, False), (twice, True)):
        found = detector.newcomers(shown, [known.region], 0)
        away = [np.linalg.norm(each.hips - known.hips + (400, 0)) / known.radius for each in found]
        assert any(each < 0.25 for each in away) == wanted
        assert all(np.linalg.norm(each.hips - known.hips) > 0.25 * known.radius for each in found)


@pytest.mark.parametrize("name", ["lite", "full", "heavy", "openpose"])
def test_peaks_of_a_mirrored_picture_are_the_mirrored_peaks(name, picture, region):
    """To a fifth of a cell: half a cell off, as with the other convention, would show as one whole."""
    made = network(name)
    across = picture.shape[1] - 1
    mirrored = PersonRegion(
        np.array([across - region.centre[0], region.centre[1]]), region.size, -region.roll
    )
    there, likely = peaks(made.heat_maps(picture, region))
    maps = made.heat_maps(np.ascontiguousarray(picture[:, ::-1]), mirrored)
    back, likely_back = peaks(maps)
    names = made.keypoints
    swapped = [
        names.index(n.replace("left", "@").replace("right", "left").replace("@", "right")) for n in names
    ]
    sure = np.minimum(likely, likely_back[swapped]) > 0.3
    assert sure.sum() > 10
    cells = (there[:, 0] + back[swapped, 0] - across)[sure] * abs(
        np.linalg.det(maps.map_from_pixel[:, :2])
    ) ** 0.5
    assert abs(np.median(cells)) < 0.6
    assert abs(np.mean(np.clip(cells, -3, 3))) < 0.6


def test_a_person_is_followed_and_found_again(picture):
    follower = follower_of(network("lite"), PersonDetector(2), 1)
    assert follower.heat_maps(np.zeros_like(picture)) == {}
    maps = follower.heat_maps(picture)[0]
    assert maps is not None
    assert maps.likelihood.shape == (33, 64, 64)
    assert 0 <= maps.likelihood.min() <= maps.likelihood.max() <= 1
    follower.heat_maps(np.zeros_like(picture))  # the person has gone: the region is forgotten
    assert follower.heat_maps(np.zeros_like(picture)) == {}
    assert follower.heat_maps(picture)[0] is not None
