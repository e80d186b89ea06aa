"""The page of a recording."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from devices.link import Framing
from devices.recording_writer import RecordingWriter, session_record
from gateway.errors import GatewayError
from gateway.frames import Status
from gateway.recording import open_recording
from gateway.recording.exporters.message_file import samples_of
from gateway.recording.summary import summarise
from gateway.report import gather, write_report
from gateway.stages import modules

SECTIONS = ["Modules", "Loss over time", "Clocks", "Status", "Confidence", "Orientations", "Joint angles",
            "Events", "Settings", "Rig", "Software"]  # fmt: skip


class _Page(HTMLParser):
    """Headings, and every address that the page would fetch."""

    def __init__(self, text):
        super().__init__()
        self.headings, self.addresses, self._open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self._open.append(tag)
        self.addresses += [value for key, value in attrs if key in {"src", "href", "srcset", "data"}]

    def handle_data(self, data):
        if self._open and self._open[-1] == "h2" and data.strip():
            self.headings.append(data)


def test_the_page_has_everything_and_loads_nothing(record, typed, tmp_path):
    target = tmp_path / "arm.html"
    code, told = typed("report", record(), "-o", target, "--json")
    assert (code, told["defect"]) == (0, None)
    text = target.read_text()
    page = _Page(text)
    for section in SECTIONS:
        assert any(heading.startswith(section) for heading in page.headings), section
    assert page.addresses
    assert all(address.startswith("data:image/png;base64,") for address in page.addresses)
    assert not re.search(r"@import|url\(|<script|<link", text)
    assert "base" in text
    assert "&quot;segment&quot;: &quot;base&quot;" in text, "the reset among the events"


def test_nothing_is_solved_to_see_what_came(record, monkeypatch):
    """The method of a recording may be one that takes minutes to compile."""

    def refuse(*_arguments):
        raise AssertionError("a method is built")

    recording = open_recording(record())
    monkeypatch.setattr(modules, "create_reconstructor", refuse)
    assert gather(recording).modules
    assert next(samples_of(recording))


def test_figures_are_those_of_the_recording(record):
    recording = open_recording(record())
    found, summary = gather(recording), summarise(recording)
    received = {str(module.module): np.nansum(module.received) for module in found.modules}
    assert received == {name: each["received"] for name, each in summary.modules.items()}
    assert sum(np.nansum(module.lost) for module in found.modules) == sum(
        m["lost"] for m in summary.modules.values()
    )
    frames = list(recording.skeleton_frames())
    assert found.n_poses == len(frames)
    measured = sum(int((frame.status == Status.MEASURED).sum()) for frame in frames)
    assert found.status_counts[:, Status.MEASURED].sum() == measured
    assert len(found.poses.time_ns) == len(frames)


def test_a_cut_off_recording_still_has_a_page(record, typed, tmp_path):
    path = record()
    whole = gather(open_recording(path)).n_poses
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size * 2 // 3)
    code, told = typed("report", path, "-o", tmp_path / "a.html", "--json")
    assert code == 0
    assert 0 < told["poses"] < whole
    assert "was not closed" in told["defect"]
    assert "was not closed" in (tmp_path / "a.html").read_text()


def test_a_recording_without_suit_or_content_has_a_page(typed, tmp_path):
    path = tmp_path / "card.mcap"
    with RecordingWriter(path, session_record({"card": Framing.BYTE_STREAM}, begun_ns="0"), {}, 0):
        pass
    assert typed("report", path, "-o", tmp_path / "card.html")[0] == 0
    assert "tells no suit" in (tmp_path / "card.html").read_text()


def test_the_same_recording_gives_the_same_page(record, tmp_path):
    path = record()
    for name in ("a.html", "b.html"):
        write_report(gather(open_recording(path)), tmp_path / name)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_nothing_is_overwritten_unasked(record, typed, tmp_path):
    target = tmp_path / "a.html"
    target.write_text("mine")
    with pytest.raises(GatewayError, match="replace it with --force"):
        typed("report", record(), "-o", target)
    assert typed("report", record(name="b"), "-o", target, "--force")[0] == 0
    assert target.read_text().startswith("<!doctype html>")


@pytest.mark.parametrize("name", ["a.pdf", "a.mcap", "a"])
def test_a_page_is_not_written_into_a_file_of_another_kind(name, record, typed, tmp_path):
    with pytest.raises(GatewayError, match=r"name it a\.html"):
        typed("report", record(), "-o", tmp_path / name)
    assert not (tmp_path / name).exists()
