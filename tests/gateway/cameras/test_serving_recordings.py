"""A recording in the place of cameras."""

import pytest

pytest.importorskip("cv2")

from devices.cameras.heat_map_messages import HeatMapReceiver
from devices.cameras.pictures import CameraError
from gateway.cameras.camera_process import CameraTask
from gateway.cameras.serving import Served, serve
from gateway.emulation.video_truth import messages_of, ring_of_cameras, walking
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.recording.video import video_suit, write_solved_video

pytestmark = pytest.mark.timeout(600)  # whichever test comes first compiles

CAMERAS = ring_of_cameras(3)
KEYPOINTS = load_keypoint_set("blazepose_33")
N = 5


class Collected:
    """A sink that keeps what it is given."""

    def __init__(self):
        self.served = Served()
        self.messages = []

    def wait_for_first(self):
        """Somebody is there."""

    def offer(self, message):
        self.messages.append(message)

    def newest_line(self):
        """Nobody tells anything."""
        return b""

    def close(self):
        """Nothing is waiting."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    instants = messages_of(CAMERAS, KEYPOINTS, walking(KEYPOINTS, N, (-0.2, 0.1), (1.0, 0.2)))
    path = tmp_path_factory.mktemp("walk") / "walk.mcap"
    write_solved_video(instants, 60.0, video_suit(CAMERAS, "full", instants), "walker", path)
    return path, instants


def test_the_heat_maps_of_one_camera_are_served_as_they_were_recorded(recording):
    path, instants = recording
    sink = Collected()
    serve([CameraTask(CAMERAS[1].name, str(path), "full")], sink, speed=0.0)
    assert sink.messages[:N] == [instant[1] for instant in instants]
    later = [HeatMapReceiver().receive(message)[0].sequence for message in sink.messages[N:]]
    assert later == list(range(N, N + 3))  # the last instant again, for the smoothing


def test_a_camera_that_the_recording_does_not_have_is_told(recording):
    with pytest.raises(CameraError, match=r"no camera 'left' \(its cameras: ring0, ring1, ring2\)"):
        serve([CameraTask("left", str(recording[0]), "full")], Collected(), speed=0.0)
