"""``config check`` looks at every file and folder that a configuration names, as ``run`` would use them."""

from __future__ import annotations

import pytest
import yaml

from gateway.body.rig import load_rig
from gateway.doctor.examination import examine_file
from gateway.doctor.findings import Verdict
from gateway.doctor.named_files import trouble_with_files
from gateway.errors import SettingsError
from gateway.settings import load_gateway_settings

PLAIN = {"rig": "single", "reconstructor": "independent", "links": [{"name": "suit", "url": "/dev/ttyUSB0"}]}


@pytest.fixture
def trouble(tmp_path):
    """``trouble(mqtt={…})``: what is found of a configuration in a folder with a text and nothing else."""
    (tmp_path / "text").write_text("neither key nor certificate\n")

    def find(**settings):
        config = tmp_path / "gateway.yaml"
        config.write_text(yaml.safe_dump(PLAIN | settings))
        read = load_gateway_settings(config)
        return list(trouble_with_files(read, load_rig(read.rig, config), config))

    return find


def of_file(path):
    """Settings that name a file, by what a complaint is to begin with."""
    return {
        "'mqtt.password_file'": {"mqtt": {"username": "a", "password_file": path}},
        "'mqtt.websocket_token_file'": {"mqtt": {"broker": "embedded", "websocket_token_file": path}},
        "'mqtt.tls.ca_file'": {"mqtt": {"tls": {"ca_file": path}}},
        "'mqtt.tls.certificate'": {"mqtt": {"tls": {"certificate": path, "key": path}}},
        "'metrics.token_file'": {"metrics": {"port": 9464, "token_file": path}},
        "'clock.table'": {"clock": {"mode": "table", "table": path}},
        "'outputs.opensim.model'": {"outputs": {"opensim": {"model": path}}},
        "'outputs.retarget.urdf'": {"outputs": {"retarget": {"robot": "icub", "urdf": path}}},
        "link 'suit': url": {"links": [{"name": "suit", "url": f"{path}.mcap"}]},
        "link 'cams': url": {
            "links": [*PLAIN["links"], {"name": "cams", "carries": "markers", "url": f"markers://{path}.c3d"}]
        },
    }


@pytest.mark.parametrize("beginning", of_file("x"))
def test_a_file_that_is_not_there_is_named_with_its_setting_and_a_remedy(trouble, tmp_path, beginning):
    found = trouble(**of_file(str(tmp_path / "absent"))[beginning])
    assert found
    assert found[0].startswith(beginning)
    assert f"{tmp_path}/absent" in found[0]
    assert "no such file" in found[0]
    assert "correct the path" in found[0]


@pytest.mark.parametrize(
    ("beginning", "told"),
    [
        ("'mqtt.tls.ca_file'", "no certificate in PEM"),
        ("'mqtt.tls.certificate'", "name the two files that were made together"),
        ("'metrics.token_file'", "'metrics': a token is 16 or more letters"),
        ("'mqtt.websocket_token_file'", "a token is 16 or more letters"),
        ("'outputs.retarget.urdf'", "'outputs.retarget': "),
    ],
)
def test_a_file_of_something_else_is_refused(trouble, tmp_path, beginning, told):
    assert told in "\n".join(trouble(**of_file(str(tmp_path / "text"))[beginning]))


def test_a_folder_for_recordings_is_one_that_can_be_written(trouble, tmp_path):
    assert trouble(recording={"folder": str(tmp_path / "new" / "deeper")}) == []
    assert not (tmp_path / "new").exists()
    for folder in (tmp_path / "text", tmp_path / "text" / "below", "/proc/recordings"):
        (line,) = trouble(recording={"folder": str(folder)})
        assert line.startswith(f"'recording.folder' is {folder}: ")
        assert "name a folder that this user may write" in line
    (line,) = trouble(mqtt={"late": {"folder": "/proc/late"}})
    assert line.startswith("'mqtt.late.folder' is /proc/late: ")


def test_all_that_is_wrong_is_told_at_once(trouble):
    wrong = {"recording": {"folder": "/proc/x"}, "clock": {"mode": "table", "table": "absent"}}
    assert len(trouble(**wrong, metrics={"port": 9464, "token_file": "absent"})) == 3


def test_the_doctor_names_the_files_too(tmp_path):
    config = tmp_path / "gateway.yaml"
    wrong = {"metrics": {"port": 9464, "token_file": str(tmp_path / "absent")}}
    config.write_text(yaml.safe_dump(PLAIN | wrong | {"mqtt": {"broker": "embedded"}}))
    (found,) = [each for each in examine_file(config, None, 0) if each.subject == "files"]
    assert found.verdict is Verdict.BAD
    assert found.found.startswith(f"'metrics.token_file' is {tmp_path}/absent: no such file")
    assert found.remedy == "correct the path, or make the file"


def test_nothing_is_found_of_a_good_configuration(trouble):
    assert trouble() == []


@pytest.mark.parametrize(
    "content",
    [
        "asyncapi: 3.0.0\ninfo: {}\n",
        "body: single\nworld: {}\n",
        "just a text",
        "- one\n",
        "# A\nb: c\nd",
    ],
)
def test_a_file_that_is_no_configuration_is_told_what_is_wanted(tmp_path, content):
    config = tmp_path / "other.yaml"
    config.write_text(content)
    with pytest.raises(SettingsError) as caught:
        load_gateway_settings(config)
    assert "\n" not in str(caught.value)
    assert "'key: value' lines" in str(caught.value)
    assert "unknown setting" not in str(caught.value)
