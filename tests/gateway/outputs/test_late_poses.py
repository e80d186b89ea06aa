"""Poses that no broker took: the file that keeps them."""

from __future__ import annotations

import time
from pathlib import Path

import orjson
import pytest

from gateway.errors import OutputError
from gateway.outputs.late_poses import CONFIRMED_S, LatePoses


def pose(seq: int) -> bytes:
    return orjson.dumps({"t_ns": 10 * seq, "seq": seq})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "late" / "lab.late.jsonl"


def test_poses_come_out_in_order_and_marked(path: Path):
    late = LatePoses(path, "ab12", 1)
    for seq in range(5):
        late.keep(pose(seq))
    first = [orjson.loads(text) for text in late.next(3, 77)]
    late.done(3)
    assert first[0] == {"t_ns": 0, "seq": 0, "instance": "ab12", "sent_ns": 77}
    assert [orjson.loads(text)["seq"] for text in late.next(3, 78)] == [3, 4]
    late.done(2)
    assert (late.has_some, path.stat().st_size, late.sent) == (False, 0, 5)


def test_what_was_not_acknowledged_is_given_again(path: Path):
    late = LatePoses(path, "ab12", 1)
    late.keep(pose(1))
    assert late.next(10, 5) == late.next(10, 5) != []


def test_only_poses_that_are_not_confirmed_are_kept(path: Path):
    late = LatePoses(path, "ab12", 1)
    late.published(pose(1))
    late.confirmed(time.monotonic() + CONFIRMED_S + 0.1)
    late.published(pose(2))
    late.connection_lost()
    late.connection_lost()
    assert [orjson.loads(text)["seq"] for text in late.next(10, 0)] == [2]


def test_an_earlier_run_is_sent_with_its_own_instance_and_torn_lines_are_left_out(path: Path):
    earlier = LatePoses(path, "first", 1)
    for seq in range(4):
        earlier.keep(pose(seq))
    earlier.next(1, 0)
    earlier.done(1)
    earlier.close()
    with path.open("ab") as file:
        file.write(b'{"t_ns":')  # a power cut
    late = LatePoses(path, "second", 1)
    given = [orjson.loads(text) for text in late.next(10, 0)]
    assert [(each["instance"], each["seq"]) for each in given] == [("first", 1), ("first", 2), ("first", 3)]
    late.done(3)
    assert not late.has_some


def test_what_is_kept_next_does_not_join_a_torn_line(path: Path):
    path.parent.mkdir()
    path.write_bytes(b'{"seq":1}\n{"seq":2,"t_')
    late = LatePoses(path, "ab12", 1)
    late.keep(pose(3))
    assert [orjson.loads(text)["seq"] for text in late.next(10, 5)] == [1, 3]


def test_a_pose_that_a_full_disk_takes_half_of_is_counted_and_leaves_nothing(
    path: Path, monkeypatch: pytest.MonkeyPatch
):
    late = LatePoses(path, "ab12", 1)
    late.keep(pose(1))
    file, before = late._file, path.read_bytes()

    class Full:
        def write(self, data: bytes) -> int:
            return file.write(data[:7])

        def __getattr__(self, name: str) -> object:
            return getattr(file, name)

    monkeypatch.setattr(late, "_file", Full())
    late.keep(pose(2))
    assert (late.kept, late.left_out, path.read_bytes()) == (1, 1, before)


def test_what_has_no_room_is_counted(path: Path, caplog: pytest.LogCaptureFixture):
    late = LatePoses(path, "ab12", 0.0002)
    for seq in range(20):
        late.keep(pose(seq))
    assert late.kept + late.left_out == 20
    assert late.left_out > 0
    assert len([record for record in caplog.records if "most_mb" in record.message]) == 1


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"mqtt\.late\.folder: .*name a folder of your own"):
        LatePoses(tmp_path / "file" / "lab.late.jsonl", "ab12", 1)
