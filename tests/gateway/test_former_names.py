"""What has words of the release before is read, and told once."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
import yaml

from gateway.body.rig import load_rig
from gateway.contract.requests import asked
from gateway.modules.journal import Journal
from gateway.recording.snapshot import decode_suit, encode_suit, rig_of
from gateway.support import former_names
from gateway.support.former_names import current
from gateway.support.settings_files import shipped_folder

BIAS = [0.01, -0.02, 0.03]


@pytest.fixture(autouse=True)
def nothing_told_yet():
    former_names._warn.cache_clear()


@pytest.fixture
def rig_text():
    """A shipped rig with a calibrated module, as the release before wrote it."""
    rig = yaml.safe_load((shipped_folder() / "rigs" / "arm_3.yaml").read_text())
    rig["modules"][0]["calibration"] = {"gyrometer": {"bias": BIAS}}
    return yaml.safe_dump(rig)


def test_a_rig_file_is_read_and_its_words_are_told_once(tmp_path, rig_text, caplog):
    (tmp_path / "mine.yaml").write_text(rig_text)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            suit = load_rig(str(tmp_path / "mine.yaml"))
    calibration = next(iter(suit.calibrations.values()))
    np.testing.assert_allclose(calibration.gyroscope_bias, BIAS)
    assert [record.message for record in caplog.records] == [
        "'gyrometer' is called 'gyroscope' now: the next release will not read the former name"
    ]


def test_a_suit_in_a_recording_is_the_same_with_the_former_words(tmp_path, rig_text):
    (tmp_path / "mine.yaml").write_text(rig_text)
    text = encode_suit(load_rig(str(tmp_path / "mine.yaml")))
    former = text.replace(b"gyroscope_bias", b"gyrometer_bias")
    assert former != text
    assert encode_suit(decode_suit(former)) == text
    assert "gyroscope" in json.dumps(rig_of(decode_suit(former)))


def test_requests_may_use_the_former_words():
    request = asked("sensors", "begin", {"sensors": ["gyrometer", "magnetometer"]})
    assert request.model_dump()["sensors"] == ["gyroscope", "magnetometer"]


def test_a_change_that_was_kept_before_can_be_undone(tmp_path):
    file = tmp_path / "module_changes.json"
    values = {"before": {"gyrometer_range": 8.7}, "after": {"gyrometer_range": 34.9}}
    file.write_text(json.dumps([{"key": "a", "modules": {"ab" * 12: values}}]))
    (change,) = Journal(file).last().changes
    assert (change.before, change.after) == ({"gyroscope_range": 8.7}, {"gyroscope_range": 34.9})


@pytest.mark.parametrize(
    "text", ["my gyrometer", "gyrometers are fine", "thegyrometer", "Gyrometer", "", 3, None]
)
def test_other_texts_stay(text):
    assert current({"label": text, "list": [text]}) == {"label": text, "list": [text]}
    assert current({text: 1}) == {text: 1}
