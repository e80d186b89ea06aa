"""The wearer's measures and calibrations are kept, and the configuration names where."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from gateway.body.anthropometry import lengths_of
from gateway.body.body_file import load_body
from gateway.body.rig import load_rig
from gateway.calibration.control import CalibrationControl
from gateway.calibration.kept_rig import KeptRig, measured, rig_advice
from gateway.calibration.mounting import history
from gateway.cli.main import app
from gateway.errors import GatewayError
from gateway.pipeline import Pipeline
from gateway.settings import load_gateway_settings

TEXT = """\
gateway: lab # mine
links: [{name: suit, url: /dev/ttyUSB7}]
rig: arm_3 # as shipped
reconstructor: independent
"""


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "gateway.yaml"
    path.write_text(TEXT)
    return path


def test_the_name_that_is_told_holds_wherever_the_gateway_is_started(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path.parent)
    rig = KeptRig("arm_3", config).target
    assert rig_advice(rig, config) == f"written to {rig}: use it as 'rig: arm_3.worn.yaml'"
    assert rig_advice(Path("mine.yaml"), config).endswith(f"'rig: {tmp_path.parent / 'mine.yaml'}'")
    assert rig_advice(Path("mine.yaml"), None).endswith("'rig: mine.yaml'")


@pytest.mark.parametrize("what", ["body", "sensors", "clocks"])
def test_a_folder_that_is_not_there_is_told_before_anything_is_measured(config, tmp_path, what):
    """The link is absent too: that would be told had it been opened."""
    target = tmp_path / "absent" / "mine.yaml"
    shown = CliRunner().invoke(app, ["calibrate", what, "-c", str(config), "-o", str(target)])
    assert isinstance(shown.exception, GatewayError)
    assert "there is no folder" in str(shown.exception)


def test_measures_go_beside_the_configuration_which_names_the_file_from_then_on(config):
    rig = KeptRig("arm_3", config)
    subject, body = rig.keep_subject({"lengths": {"right_forearm": 0.3}})
    assert rig.name_in_configuration()
    assert config.read_text() == TEXT.replace("rig: arm_3 ", 'rig: "arm_3.worn.yaml" ')
    worn = load_rig(load_gateway_settings(config).rig, config)
    np.testing.assert_allclose(worn.skeleton.tips, body.tips)
    assert lengths_of(worn.skeleton)["right_forearm"] == subject.lengths["right_forearm"] == 0.3


def test_what_is_measured_later_leaves_the_rest_and_keeps_the_earlier_file(config):
    rig = KeptRig("suit_17", config)
    rig.keep_subject({"height_m": 1.6, "lengths": {"thigh": 0.4, "shank": 0.38}})
    subject, _ = rig.keep_subject({"mass_kg": 55, "lengths": {"thigh": None}})
    assert subject.as_json() == {"height_m": 1.6, "mass_kg": 55.0, "lengths": {"shank": 0.38}}
    assert rig.subject() == subject
    assert len(history(rig.target)) == 1


@pytest.mark.parametrize(
    ("shipped", "changes", "said"),
    [("arm_3", {"lengths": {"tihgh": 0.4}}, "tihgh"), ("chain_5", {"height_m": 1.7}, "stature")],
)
def test_measures_that_the_body_does_not_have_are_refused_and_nothing_is_written(
    config, shipped, changes, said
):
    with pytest.raises(GatewayError, match=said):
        KeptRig(shipped, config).keep_subject(changes)
    assert config.read_text() == TEXT
    assert [path.name for path in config.parent.iterdir()] == ["gateway.yaml"]


def test_a_configuration_that_names_another_rig_meanwhile_is_left_alone(config):
    rig = KeptRig("arm_3", config)
    rig.keep_subject({"lengths": {"right_upper_arm": 0.2}})
    config.write_text(TEXT.replace("arm_3", "arm_4"))
    assert not rig.name_in_configuration()
    assert "arm_4" in config.read_text()


def test_a_rig_file_of_ones_own_is_written_itself(config):
    own = config.parent / "mine.yaml"
    content = yaml.safe_load((config.parents[0] / "gateway.yaml").read_text())
    shipped = KeptRig("arm_3", config).configured
    own.write_text(shipped.read_text())
    config.write_text(yaml.safe_dump(content | {"rig": "mine.yaml"}))
    before = config.read_text()
    rig = KeptRig("mine.yaml", config)
    rig.keep_subject({"lengths": {"right_upper_arm": 0.2}})
    assert rig.name_in_configuration()
    assert rig.target.resolve() == own.resolve()
    assert config.read_text() == before


@pytest.fixture
def control(config):
    """``control(config)``: what obeys the family, and how often the configuration was read anew."""

    def make(named=config):
        settings, read = load_gateway_settings(config), []

        async def read_anew():
            read.append(load_gateway_settings(config).rig)

        pipeline = Pipeline.from_settings(settings, load_rig("arm_3"))
        return CalibrationControl(pipeline, KeptRig("arm_3", named), None, read_anew), read

    return make


def test_the_request_tells_measures_and_has_new_ones_worn(control):
    made, read = control()
    told = asyncio.run(made.perform("measure", {}))
    assert told["subject"] == {}
    assert told["lengths"] == lengths_of(load_body("arm_3"))
    answer = asyncio.run(made.perform("measure", {"lengths": {"right_forearm": 0.3}}))
    assert answer["subject"] == {"lengths": {"right_forearm": 0.3}}
    assert answer["lengths"]["right_forearm"] == 0.3
    assert read == ["arm_3.worn.yaml"]


def test_measures_wait_for_poses_that_were_begun_and_want_a_file(control):
    made, read = control()
    asyncio.run(made.perform("begin", {}))
    with pytest.raises(GatewayError, match="cancel them"):
        asyncio.run(made.perform("measure", {"lengths": {"right_forearm": 0.3}}))
    without, _ = control(None)
    with pytest.raises(GatewayError, match="no configuration file"):
        asyncio.run(without.perform("measure", {"lengths": {"right_forearm": 0.3}}))
    assert not read


def test_the_terminal_keeps_measures_too(config):
    done = CliRunner().invoke(app, ["body", "measure", "-c", str(config), "--length", "right_forearm=0.3"])
    assert done.exit_code == 0, done.output
    assert '{"lengths": {"right_forearm": 0.3}}' in done.output
    assert "arm_3.worn.yaml" in config.read_text()


def test_nothing_measured_is_no_change():
    assert measured(None, None, {}) == {}


def test_a_pair_of_limbs_of_one_length_has_one_name():
    person = load_body("human_17")
    lengths = lengths_of(person)
    assert lengths["thigh"] == pytest.approx(0.245 * 1.75, abs=1e-3)
    assert lengths["hip_width"] == pytest.approx(2 * 0.0955 * 1.75, abs=1e-3)
    assert not any(name.startswith(("left_", "right_")) for name in lengths)
