"""The folder of the recordings as requests see it."""

from __future__ import annotations

import base64

import pytest

from devices.recording_file import RecordingError
from gateway.errors import GatewayError
from gateway.recording.files import Contents, SessionFiles
from gateway.recording.shelf import Shelf
from gateway.settings import RecordingSettings


async def others(verb, data):
    return {"others": verb}


@pytest.fixture
def perform(tmp_path):
    """Asks a shelf whose folder holds one file, not a whole recording; beside it lies a secret."""
    folder = tmp_path / "kept"
    folder.mkdir()
    (folder / "walk.mcap").write_bytes(bytes(range(256)) * 10)
    (folder / "notes.txt").write_text("mine")
    (tmp_path / "secret.mcap").write_text("secret")
    (folder / "linked.mcap").symlink_to(tmp_path / "secret.mcap")
    return Shelf(RecordingSettings(folder=str(folder)), lambda: None).beside(others)


async def test_a_file_is_read_piece_by_piece(perform):
    pieces, size = b"", 1
    while len(pieces) < size:
        answer = await perform("read", {"file": "walk.mcap", "offset": len(pieces), "length": 1000})
        pieces, size = pieces + base64.b64decode(answer["data"]), answer["bytes"]
    assert pieces == bytes(range(256)) * 10


@pytest.mark.parametrize("name", ["../secret.mcap", "/etc/passwd", ".hidden.mcap", "", "a/b.mcap"])
async def test_names_that_could_mean_another_folder_are_refused(perform, name):
    with pytest.raises(GatewayError, match=r"recording/read: 'file' is .*: a name of up to 128 letters"):
        await perform("read", {"file": name, "offset": 0})
    with pytest.raises(GatewayError, match=r"recording/export: 'file' is .*recording/list has them"):
        await perform("export", {"file": name, "to": "bvh"})


@pytest.mark.parametrize("name", ["linked.mcap", "notes.txt", "none.mcap"])
async def test_nothing_but_recordings_of_the_folder_is_read(perform, name):
    with pytest.raises(RecordingError, match=f"there is no recording {name}"):
        await perform("read", {"file": name, "offset": 0})


async def test_what_is_no_recording_is_told_as_a_problem(perform):
    answer = await perform("list", {})
    assert answer["recordings"] == []
    assert any("walk.mcap" in problem for problem in answer["problems"])
    assert answer["formats"]["bvh"]


@pytest.mark.parametrize("name", ["<b>Größe (2).mcap", "a" * 140 + ".mcap"])
async def test_a_recording_that_no_request_can_name_is_told_as_a_problem(tmp_path, name):
    """Listed, it could neither be replayed nor exported, and nobody would know why."""
    settings = RecordingSettings(folder=str(tmp_path), min_free_mb=0)
    files = SessionFiles(settings, Contents({}, {}, "1", from_start=True))
    files.close()
    perform = Shelf(settings, lambda: None).beside(others)
    assert len((await perform("list", {}))["recordings"]) == 1
    files.path.rename(tmp_path / name)
    answer = await perform("list", {})
    assert answer["recordings"] == []
    (problem,) = answer["problems"]
    assert problem.startswith(name[:60])
    assert problem.endswith("rename it")


async def test_an_unknown_format_and_other_verbs(perform):
    with pytest.raises(GatewayError, match=r"no format 'bvg' \(did you mean 'bvh'\?\)"):
        await perform("export", {"file": "walk.mcap", "to": "bvg"})
    assert await perform("start", {}) == {"others": "start"}


async def test_before_the_first_recording_there_is_no_folder(tmp_path):
    shelf = Shelf(RecordingSettings(folder=str(tmp_path / "none")), lambda: None)
    assert (await shelf.beside(others)("list", {}))["recordings"] == []
