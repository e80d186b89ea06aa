"""Several people and joined cameras on the command line."""

import pytest

pytest.importorskip("cv2")

from gateway.cli.video import joined_of, people_of
from gateway.cli.video_solve import _places
from gateway.errors import GatewayError
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
