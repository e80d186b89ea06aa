"""An optical and an inertial capture of one motion, by the commands that docs/guide/compare.md shows."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from devices.emulators.ring_pair import write_files
from gateway.cli.main import app

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
TRIAL = DATA / "ring_chain5" / "trial1"
pytestmark = pytest.mark.skipif(not TRIAL.is_dir(), reason=f"the recording {TRIAL} is not here")
SPAN = ("--span", "8:60")
"""Before and after, the chain lies on a metal table."""


def run(*arguments: str) -> str:
    done = CliRunner().invoke(app, list(arguments))
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Recordings of the modules and of the markers."""
    folder = tmp_path_factory.mktemp("pair")
    write_files(TRIAL, folder)
    suit, optical, subject = (str(folder / name) for name in ("suit.mcap", "optical.mcap", "ring.yaml"))
    columns, rig = str(folder / "columns.yaml"), str(folder / "ring_rig.yaml")
    run("import", str(folder / "imu.csv"), "--columns", columns, "--rig", rig, "-o", suit)
    markers, marker_set = str(folder / "ring.trc"), str(folder / "ring_set.yaml")
    run("optical", "fit", markers, "--set", marker_set, "--up", "z", "-o", subject)
    run("optical", "solve", markers, "--subject", subject, "-o", optical)
    return suit, optical


def test_the_two_agree_once_every_segment_has_its_own_heading(pair):
    found = json.loads(run("compare", *pair, *SPAN, "--own-headings", "--json"))
    assert found["time"]["correlation"] > 0.7
    assert abs(found["time"]["lag_s"] - 0.02) < 0.015  # optical instants lag by a module's sample, it is told
    for figures in found["segments"]:
        assert figures["inclination_rms_deg"] < 4.0, figures
        assert figures["axes_apart_deg"] < 4.0, figures
        assert figures["rms_deg"] < 9.0, figures
    headings = [figures["own_heading_deg"] for figures in found["segments"]]
    assert max(headings) - min(headings) > 30.0  # the room's field is not homogeneous


def test_with_one_heading_for_all_it_is_said_what_is_wrong(pair):
    done = CliRunner().invoke(app, ["compare", *pair, *SPAN])
    assert done.exit_code == 0
    assert "with --own-headings the mean RMS is" in done.output
