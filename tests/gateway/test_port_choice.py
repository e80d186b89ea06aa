"""A link is given a port that is there, in the configuration file and at once."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest
import yaml

from devices.links.reconnect import LinkState, ReconnectingLink
from gateway.contract.requests import ConnectRequest
from gateway.doctor.findings import Surroundings
from gateway.doctor.port_choice import PortChoice, url_of
from gateway.errors import GatewayError
from gateway.settings import load_gateway_settings
from gateway.support import yaml_text

TEXT = """\
# mine
gateway: lab
links:
  - name: suit # the receiver
    url: /dev/ttyUSB7?baud=921600 # it was there once
  - {name: relay, url: "/dev/ttyUSB1"}
rig: arm_3
"""


@pytest.fixture
def choice(tmp_path, monkeypatch):
    """``choice(up=..., refuses=...)``: what obeys the request, and the file."""
    config = tmp_path / "gateway.yaml"
    config.write_text(TEXT)
    ports = ["/dev/ttyUSB0", "/dev/ttyUSB1"]
    monkeypatch.setattr("gateway.doctor.inside.serial_ports", lambda: ports)
    settings = load_gateway_settings(config)

    def make(up=(), refuses=None):
        links = []
        for each in settings.links:
            link = ReconnectingLink(SimpleNamespace(name=each.name, framing=None))
            if each.name in up:
                link.status = SimpleNamespace(state=LinkState.UP)
            links.append(link)
        service = SimpleNamespace(settings=settings, links=links)

        async def read_anew():
            load_gateway_settings(config)
            if refuses is not None:
                raise GatewayError(refuses)

        return PortChoice(config, service, read_anew, Surroundings(sysfs=tmp_path)), config

    return make


def connect(choice, link, port):
    return asyncio.run(choice.connect(ConnectRequest(link=link, port=port)))


def test_only_the_url_changes_in_the_file(choice):
    made, config = choice()
    answer = connect(made, "suit", "/dev/ttyUSB0")
    assert answer == {"link": "suit", "url": "/dev/ttyUSB0?baud=921600"}
    assert config.read_text() == TEXT.replace("/dev/ttyUSB7?baud=921600 ", '"/dev/ttyUSB0?baud=921600" ')


@pytest.mark.parametrize(
    ("link", "port", "said"),
    [
        ("siut", "/dev/ttyUSB0", "there is no link 'siut' .did you mean 'suit'"),
        ("suit", "/etc/passwd", "no port '/etc/passwd'; there are: /dev/ttyUSB0, /dev/ttyUSB1"),
        ("suit", "/dev/ttyUSB1", "used by link 'relay'"),
        ("relay", "/dev/ttyUSB0", "link 'relay' is up at /dev/ttyUSB1"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(choice, link, port, said):
    made, config = choice(up=["relay"])
    with pytest.raises(GatewayError, match=said):
        connect(made, link, port)
    assert config.read_text() == TEXT


def test_a_file_that_cannot_run_is_put_back(choice):
    made, config = choice(refuses="the broker's port is taken")
    with pytest.raises(GatewayError, match="port is taken"):
        connect(made, "suit", "/dev/ttyUSB0")
    assert config.read_text() == TEXT


@pytest.mark.parametrize(
    ("port", "before", "after"),
    [
        ("/dev/ttyACM0", "tcp://10.0.0.1:7000?key_file=k", "/dev/ttyACM0"),
        ("/dev/ttyACM0", "slcan:///dev/ttyACM7?bitrate=500000", "slcan:///dev/ttyACM0?bitrate=500000"),
        ("can1", "can://socketcan/can0?fd=1", "can://socketcan/can1?fd=1"),
        ("can1", "/dev/ttyUSB0?baud=9600", "can://socketcan/can1"),
    ],
)
def test_what_fits_of_the_former_url_stays(port, before, after):
    assert url_of(port, before) == after


@pytest.mark.parametrize("place", [("links", 5, "url"), ("links", 0, "name", "x"), ("rigs",), ("links",)])
def test_a_place_that_is_not_in_a_text_is_an_error(place):
    with pytest.raises(KeyError):
        yaml_text.replaced(TEXT, place, "x")


@pytest.mark.parametrize("value", ['a "quoted": # text', "ä\n", "", "1e3"])
def test_any_text_is_read_back_as_it_was_given(value):
    changed = yaml.safe_load(yaml_text.replaced(TEXT, ("links", 1, "name"), value))
    assert changed == yaml.safe_load(TEXT) | {
        "links": [yaml.safe_load(TEXT)["links"][0], {"name": value, "url": "/dev/ttyUSB1"}]
    }
