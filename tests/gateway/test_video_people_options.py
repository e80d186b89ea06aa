"""Several people and joined cameras on the command line."""

import pytest

pytest.importorskip("cv2")

from dataclasses import replace

from gateway.body.rig import load_rig
from gateway.body.subject_file import write_subject
from gateway.cli.video import _beside, joined_of, people_of
from gateway.cli.video_solve import _places
from gateway.errors import GatewayError
from gateway.recording.video import video_subject, video_suit
from tests import seen_walk
from tests.ring_of_cameras import CAMERAS


def test_how_many_people():
    assert (people_of("1"), people_of("3"), people_of("all")) == (1, 3, None)
    for text in ("0", "5", "two", "-1", ""):
        with pytest.raises(GatewayError, match=f"--people {text}: a number from 1 to 4 is wanted, or all"):
            people_of(text)


def test_which_cameras_stand_side_by_side():
    assert joined_of(["a+c", "d+b"], CAMERAS) == ((0, 2), (3, 1))
    for text in ("a", "a+e", "a+a", "+a"):
        with pytest.raises(GatewayError, match=r"--join .*: CAMERA\+CAMERA is wanted, such as a\+d"):
            joined_of([text], CAMERAS)
    with pytest.raises(GatewayError, match="a camera has one neighbour at the most"):
        joined_of(["a+b", "b+c"], CAMERAS)


def test_nobodys_recording_is_replaced_unasked(tmp_path):
    target = tmp_path / "walk.mcap"
    assert [place.name for place in _places(target, 2, force=False)] == ["walk_1.mcap", "walk_2.mcap"]
    (tmp_path / "walk_2.mcap").touch()
    assert _places(target, 1, force=False) == [target]
    with pytest.raises(GatewayError, match=r"walk_2\.mcap exists: .* --force"):
        _places(target, 2, force=False)
    assert len(_places(target, 2, force=True)) == 2


def test_a_camera_beside_another_is_named_with_its_place():
    assert _beside("a", "v4l:///dev/video0", None) == [("a", "v4l:///dev/video0")]
    assert _beside("a", "left.mp4", "b=right.mp4") == [("a", "left.mp4"), ("b", "right.mp4")]
    for text in ("right.mp4", "=right.mp4", "b=", "a=right.mp4"):
        with pytest.raises(GatewayError, match="NAME=PLACE is wanted"):
            _beside("a", "left.mp4", text)
    with pytest.raises(GatewayError, match="is a recording"):
        _beside("a", "walk.mcap", "b=right.mp4")


def test_cameras_side_by_side_stand_in_the_rig(tmp_path):
    messages, _ = seen_walk.seen_walk(3)
    suit = video_suit(seen_walk.CAMERAS, "full", messages)
    suit = replace(suit, video=replace(suit.video, pairs=((2, 0),)))
    path = tmp_path / "room.yaml"
    write_subject(path, video_subject("room", suit))
    text = path.read_text()
    assert text.count("[ring2, ring0]") == 1
    assert load_rig(str(path)).video.pairs == ((2, 0),)
    for names in ("[ring2, ring9]", "[ring2, ring2]"):
        path.write_text(text.replace("[ring2, ring0]", names))
        with pytest.raises(GatewayError, match=r"video\.joined: 'ring[29]' is no camera, or stands"):
            load_rig(str(path))
