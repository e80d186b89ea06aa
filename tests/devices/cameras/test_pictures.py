"""Pictures from files and folders."""

import numpy as np
import pytest

pytest.importorskip("cv2")

import cv2

from devices.cameras.pictures import CameraError, open_pictures


def shade(index):
    return np.full((48, 64, 3), min(20 * index, 255), dtype=np.uint8)


def film(path, n=10, rate=25.0):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (64, 48))
    for index in range(n):
        writer.write(shade(index))
    writer.release()
    return path


def test_a_film_gives_its_pictures_in_order_at_its_rate(tmp_path):
    source = open_pictures(str(film(tmp_path / "cam.mp4")))
    assert (source.info.name, source.info.width, source.info.height) == ("cam", 64, 48)
    assert source.info.count == 10
    times, pictures = zip(*source, strict=True)
    assert times == tuple(round(i * 1e9 / 25) for i in range(10))
    assert [picture.mean() for picture in pictures] == pytest.approx([20 * i for i in range(10)], abs=4)


def test_a_folder_goes_by_numbers_and_not_by_letters(tmp_path):
    for index in (2, 10, 1):
        cv2.imwrite(str(tmp_path / f"p{index}.png"), shade(index))
    source = open_pictures(str(tmp_path), 100.0)
    found = list(source)
    assert [picture.mean() for _, picture in found] == [20, 40, 200]
    assert [time for time, _ in found] == [0, 10_000_000, 20_000_000]


def test_images_of_two_sizes_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), shade(1))
    cv2.imwrite(str(tmp_path / "2.png"), shade(1)[:20])
    with pytest.raises(CameraError, match="64×20 pixels, the images before it 64×48"):
        list(open_pictures(str(tmp_path)))


def test_a_film_that_was_cut_off_is_told(tmp_path):
    path = film(tmp_path / "cam.avi", 60)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(CameraError, match=r"cam\.avi"):
        list(open_pictures(str(path)))


def test_a_file_without_its_index_says_so(tmp_path):
    path = film(tmp_path / "cam.mp4", 60)
    path.write_bytes(path.read_bytes()[:-300])  # the end of the index, which stands last
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.index(b"moov") - 4])
    with pytest.raises(CameraError, match=r"cam\.mp4: has no index"):
        open_pictures(str(path))


class Capture:
    """Pictures 40 ms apart, of which some are missing; so many are promised."""

    def __init__(self, missing, promised):
        self._times = [40.0 * n for n in range(10) if n not in missing]
        self._read = -1
        self._promised = promised

    def isOpened(self):  # noqa: N802 - OpenCV's name
        return True

    def read(self):
        self._read += 1
        return self._read < len(self._times), shade(self._read)

    def get(self, what):
        told = {
            cv2.CAP_PROP_FRAME_WIDTH: 64.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 48.0,
            cv2.CAP_PROP_FPS: 25.0,
            cv2.CAP_PROP_FRAME_COUNT: float(self._promised),
        }
        return told[what] if what in told else self._times[self._read]


@pytest.mark.parametrize(
    ("missing", "promised", "told"),
    [
        ((), 20, "picture 11 of 20 cannot be decoded"),
        ((4, 5), 8, "picture 5 is dated 2.0 pictures too late"),
        ((), 12, None),
        ((4,), 10, None),
    ],
)
def test_pictures_that_are_missing_are_told(tmp_path, monkeypatch, missing, promised, told):
    path = film(tmp_path / "cam.mp4")
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: Capture(missing, promised))
    source = open_pictures(str(path))
    if told is None:
        assert len(list(source)) == 10 - len(missing)
        return
    with pytest.raises(CameraError, match=told):
        list(source)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("empty.mp4", b"", "is empty"),
        ("no.mp4", None, "no such video"),
        ("text.mp4", b"hello", "no video that can be read"),
    ],
)
def test_what_is_no_video_is_told(tmp_path, name, content, told):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CameraError, match=told):
        open_pictures(str(path))


def test_an_empty_folder_is_told(tmp_path):
    with pytest.raises(CameraError, match="has no images"):
        open_pictures(str(tmp_path))


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("v4l:///dev/video77", "no camera that can be opened"),
        ("v4l:///dev/video77?zoom=2", "unknown parameter 'zoom'"),
    ],
)
def test_a_device_that_is_not_there_is_told(url, told):
    with pytest.raises(CameraError, match=told):
        open_pictures(url)


def test_a_film_stands_in_for_a_live_device(tmp_path):
    """The same capture interface; its end is what unplugging looks like."""
    source = open_pictures(f"v4l://{film(tmp_path / 'cam.mp4')}")
    assert source.info.count is None
    times = []
    with pytest.raises(CameraError, match="no more pictures"):
        times += [time for time, _ in source]
    pictures = iter(open_pictures(f"v4l://{tmp_path / 'cam.mp4'}"))
    first, second = next(pictures)[0], next(pictures)[0]
    assert first <= second
