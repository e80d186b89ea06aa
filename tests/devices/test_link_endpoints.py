"""Endpoint strings: every form, and what is wrong with a wrong one."""

from __future__ import annotations

import pytest

from devices.endpoints import EndpointError, link_from_url
from devices.link import Framing, Link, LinkError
from devices.links.can_link import CanLink
from devices.links.rfc2217_link import Rfc2217Link
from devices.links.serial_link import DEFAULT_BAUD, SerialLink
from devices.links.slcan_link import SlcanLink
from devices.links.socketcan_link import SocketCanLink
from devices.links.tcp_link import TcpLink, TcpListenLink
from devices.links.udp_link import UdpLink
from devices.replay_link import ReplayLink

FORMS = [
    ("/dev/ttyUSB0", SerialLink, {"path": "/dev/ttyUSB0", "baud": DEFAULT_BAUD}),
    ("/dev/ttyUSB0?baud=115200", SerialLink, {"path": "/dev/ttyUSB0", "baud": 115_200}),
    ("serial:///dev/pts/5?baud=1000000", SerialLink, {"path": "/dev/pts/5", "baud": 1_000_000}),
    ("serial:///dev/a%20b", SerialLink, {"path": "/dev/a b"}),
    ("rfc2217://hub:2217?baud=57600", Rfc2217Link, {"url": "rfc2217://hub:2217", "baud": 57_600}),
    ("tcp://relay.local:9000", TcpLink, {"host": "relay.local", "port": 9000}),
    ("tcp://[::1]:9000", TcpLink, {"host": "::1", "port": 9000}),
    ("socket://10.0.0.2:9000", TcpLink, {"host": "10.0.0.2", "port": 9000}),
    ("tcp://0.0.0.0:9763?listen=1", TcpListenLink, {"host": "0.0.0.0", "port": 9763}),
    ("tcp://:9763?listen=1", TcpListenLink, {"host": "127.0.0.1", "port": 9763}),
    ("tcp://relay.local:9000?listen=0", TcpLink, {"host": "relay.local", "port": 9000}),
    ("udp://:9000", UdpLink, {"host": "127.0.0.1", "port": 9000}),
    ("udp://0.0.0.0:9000", UdpLink, {"host": "0.0.0.0", "port": 9000}),
    ("slcan:///dev/ttyACM0?bitrate=1000000&fd=1", SlcanLink, {"name": "slcan:///dev/ttyACM0"}),
    ("can://socketcan/can0?fd=1&bitrate=500000", SocketCanLink, {"channel": "can0", "_fd": True}),
    ("can://virtual/suit", CanLink, {"interface": "virtual", "channel": "suit", "_settings": {}}),
    (
        "can://pcan/PCAN_USBBUS1?bitrate=500000&fd=no",
        CanLink,
        {"channel": "PCAN_USBBUS1", "_settings": {"bitrate": 500_000}},
    ),
    ("recording:///log.mcap?speed=max&link=suit", ReplayLink, {"_speed": None, "_link": "suit"}),
    ("recording:///log.mcap?speed=2.5", ReplayLink, {"_speed": 2.5}),
    ("/data/log.mcap", ReplayLink, {"_speed": 1.0}),
    ("log.mcap?speed=max", ReplayLink, {"_speed": None}),
]

WRONG = [
    ("seral:///dev/ttyUSB0", r"unknown scheme 'seral' \(did you mean 'serial'\?\)"),
    ("http://host:1", r"unknown scheme 'http' \(known: can, .*tcp, udp\)"),
    ("can0", "'can0' is neither a path .* nor a URL; .* can://socketcan/can0"),
    ("", "neither a path"),
    ("./suit", r"'\./suit': write the whole path: /.*/suit"),
    ("../suit", r"write the whole path: /(.*/)?suit"),
    ("/dev/ttyUSB0?bauds=9600", r"unknown parameter 'bauds' \(did you mean 'baud'\?\)"),
    ("/dev/ttyUSB0?baud=fast", "baud=fast: a whole number above 0 is needed"),
    ("/dev/ttyUSB0?baud=0", "baud=0: a whole number above 0 is needed"),
    ("/dev/ttyUSB0?baud=1&baud=2", "parameter 'baud' is given twice"),
    ("serial://dev/ttyUSB0", "begins with a third slash; write it like serial:///dev/ttyUSB0"),
    ("serial://", "the path is missing"),
    ("tcp://host", "the port is missing; write it like tcp://host:port"),
    ("tcp://:9000", "the host is missing"),
    ("tcp://host:99999", "ort out of range"),
    ("tcp://host:abc", "Port could not be cast"),
    ("tcp://host:1/path", "'/path' after the port means nothing"),
    ("tcp://[::1", "is no URL"),
    ("tcp://host:1?nodelay=1", r"unknown parameter 'nodelay' \(known: key_file, listen, peers\)"),
    ("tcp://host:1?peers=10.0.0.7", "peers goes with listen=1 alone"),
    ("slcan:///dev/ttyACM0?bitrate=900000", "no bit rate 900000; the nearest is 800000"),
    ("slcan:///dev/ttyACM0?fd=maybe", "fd=maybe: 1 or 0 is needed"),
    ("can://virtul/suit", r"unknown CAN interface 'virtul' \(did you mean 'virtual'\?\)"),
    ("can:///can0", "an interface and a channel are needed"),
    ("can://socketcan", "an interface and a channel are needed"),
    ("recording:///log?speed=0", "speed=0: a number above 0, or max, is needed"),
    ("recording:///log?speed=warp", "speed=warp: a number above 0, or max, is needed"),
]


@pytest.mark.parametrize(("url", "kind", "attributes"), FORMS, ids=[form[0] for form in FORMS])
def test_each_form_makes_its_link(url, kind, attributes):
    link: Link = link_from_url(url)
    assert type(link) is kind
    for attribute, value in attributes.items():
        assert getattr(link, attribute) == value
    assert link.framing is (Framing.CAN if url.startswith(("can:", "slcan:")) else Framing.BYTE_STREAM)


@pytest.mark.parametrize("url", [form[0] for form in FORMS])
def test_each_link_takes_the_name_given(url):
    assert link_from_url(url, name="left arm").name == "left arm"


@pytest.mark.parametrize(("url", "message"), WRONG, ids=[wrong[0] for wrong in WRONG])
def test_wrong_string_says_what_is_wrong_and_what_comes_nearest(url, message):
    with pytest.raises(EndpointError, match=message) as caught:
        link_from_url(url)
    assert isinstance(caught.value, LinkError)
    assert isinstance(caught.value, ValueError)
    assert "\n" not in str(caught.value)


async def test_slcan_on_a_pseudo_terminal_by_its_string(pseudo_terminal):
    terminal = pseudo_terminal()
    link = link_from_url(f"slcan://{terminal.path}?bitrate=250000&fd=1&data_bitrate=5000000")
    await link.open()
    assert await terminal.read(10) == b"C\rS5\rY5\rO\r"
    await link.close()
