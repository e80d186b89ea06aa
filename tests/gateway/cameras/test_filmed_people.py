"""Recordings and exports of people who come into a film later: on the film's time line."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from devices.cameras.heat_map_messages import retimed
from gateway.body.skeleton import VideoSetUp
from gateway.cameras.filmed_people import FilmedPeople
from gateway.cameras.live_crowd import CrowdInstant
from gateway.cli.main import app
from gateway.emulation.video_truth import RATE_HZ
from gateway.recording import open_recording
from gateway.recording.solving import verify
from gateway.recording.video import video_suit, write_offline_video, write_solved_video
from tests.seen_walk import CAMERAS, seen_walk

LATE, N = 20, 16
VIDEO = VideoSetUp(tuple(CAMERAS), "full")


@pytest.fixture(scope="module")
def late():
    """By instant a message a camera, of a film into which somebody comes after ``LATE`` pictures."""
    walk, _ = seen_walk(N)
    shown = [
        [retimed(message, index, round(index * 1e9 / RATE_HZ)) for message in instant]
        for index, instant in enumerate(walk, start=LATE)
    ]
    filmed = FilmedPeople(VIDEO, RATE_HZ)
    filmed.taken = LATE + N - 1
    filmed.add(CrowdInstant(messages={}, orders=b"", before={1: shown}))
    (messages,) = filmed.people
    assert len(messages) == LATE + N
    return messages


@pytest.mark.timeout(600)
@pytest.mark.parametrize("write", [write_solved_video, write_offline_video])
def test_every_export_begins_when_the_person_came(late, tmp_path, write):
    target = tmp_path / "late.mcap"
    write(late, RATE_HZ, replace(video_suit(CAMERAS, "full", late), video=VIDEO), "late", target)
    recording = open_recording(target)
    assert recording.skeleton_arrays().begins_s == pytest.approx(LATE / RATE_HZ, abs=1e-6)
    if write is write_solved_video:
        assert verify(recording).is_identical
    done = CliRunner().invoke(
        app, ["export", str(target), *(f"--to={name}" for name in ("trc", "csv", "bvh", "mot")), "--force"]
    )
    assert done.exit_code == 0, done.output
    times = {
        "trc": [float(line.split("\t")[1]) for line in (tmp_path / "late.trc").read_text().splitlines()[6:]],
        "csv": [float(row["time_s"]) for row in csv.DictReader((tmp_path / "late.csv").open())],
        "mot": [
            float(line.split("\t")[0])
            for line in (tmp_path / "late.mot").read_text().partition("endheader\n")[2].splitlines()[1:]
        ],
    }
    for name, found in times.items():
        assert found == pytest.approx((LATE + np.arange(N)) / RATE_HZ, abs=2e-6), name
    assert f"Frames: {N}" in (tmp_path / "late.bvh").read_text()
