"""One string for every kind of link.

========================================================  ============================================
``serial:///dev/ttyUSB0?baud=1000000``, ``/dev/ttyUSB0``  serial port or pseudo-terminal
``rfc2217://host:port?baud=1000000``                      serial port of another computer
``tcp://host:port`` (also ``socket://``)                  TCP connection made by the gateway
``tcp://0.0.0.0:port?listen=1&peers=192.168.4.7``         TCP connection made to the gateway
``udp://host:port``, ``udp://:port``                      datagrams received (this computer's only)
``udp://0.0.0.0:port?peers=192.168.4.0/24,10.0.0.7``      the same from these addresses alone
``udp://…?key_file=/path``, ``tcp://…?key_file=/path``     the same, signed in both directions
``slcan:///dev/ttyACM0?bitrate=1000000&fd=1``             CAN adapter that speaks slcan
``can://socketcan/can0?fd=1``                             CAN interface of the Linux kernel
``can://virtual/suit``, ``can://pcan/PCAN_USBBUS1``       any other interface of python-can
``qtm://host``, ``qtm://host:22223?version=1.20``          markers of Qualisys QTM, live
``markers:///path/walk.c3d?speed=max``                    C3D or TRC file of marker trajectories
``recording:///path.mcap?speed=max&link=suit``             recording; or its path, if it ends in .mcap
========================================================  ============================================

``line_rate`` says how fast the line behind one is, as far as its name says.
"""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, parse_qsl, unquote, urlsplit

from devices.known_names import nearest
from devices.link import Link, LinkError, LiveLink
from devices.links.can_link import CanLink
from devices.links.listening import Network
from devices.links.marker_file_link import MarkerFileLink
from devices.links.qtm_link import QtmLink
from devices.links.rfc2217_link import Rfc2217Link
from devices.links.serial_link import DEFAULT_BAUD, SerialLink
from devices.links.signed_link import SignedLink, read_key
from devices.links.slcan_link import DEFAULT_DATA_BITRATE, SlcanLink
from devices.links.socketcan_link import SocketCanLink
from devices.links.tcp_link import TcpLink, TcpListenLink
from devices.links.udp_link import LOOPBACK, UdpLink
from devices.recording_format import SUFFIX
from devices.replay_link import ReplayLink, speed_from

DEFAULT_BITRATE = 1_000_000
_SERIAL = frozenset({"", "serial", "rfc2217"})
_CAN = frozenset({"can", "slcan"})


class EndpointError(LinkError, ValueError):
    """An endpoint string that cannot be meant; says which part, and what comes nearest."""


def link_from_url(url: str, *, name: str | None = None) -> Link:
    """Return the link, not yet open, that ``url`` describes; ``name`` is what its chunks are to be called.

    Raises ``EndpointError`` for an unknown scheme or parameter, a missing part or a bad value.
    """
    try:
        parts = urlsplit(_as_url(url))
    except ValueError as error:
        raise EndpointError(f"{url} is no URL: {error}") from error
    scheme = _SCHEMES.get(parts.scheme)
    if scheme is None:
        raise EndpointError(_unknown_scheme(url, parts.scheme))
    try:
        return scheme.build(parts, _parameters(parts.query, scheme), name)
    except ValueError as error:
        raise EndpointError(f"{url}: {error}; write it like {scheme.example}") from error


def _as_url(text: str) -> str:
    """Return a URL for a path: of a recording by the ending of its name, else of a serial port."""
    path = text.partition("?")[0]
    if "://" not in path and path.endswith(SUFFIX):
        return f"recording:{text.removeprefix('recording:')}"
    return f"serial://{text}" if text.startswith("/") else text


def _whole_number(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) > 0):
        raise ValueError("a whole number above 0 is needed")
    return int(text)


def _flag(text: str) -> bool:
    values = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
    if text.lower() not in values:
        raise ValueError("1 or 0 is needed")
    return values[text.lower()]


def _networks(text: str) -> tuple[Network, ...]:
    try:
        return tuple(ipaddress.ip_network(part.strip(), strict=False) for part in text.split(","))
    except ValueError as error:
        raise ValueError(f"addresses are needed, such as 192.168.4.0/24,10.0.0.7 ({error})") from error


def _key(text: str) -> bytes:
    return read_key(Path(text))


def _version(text: str) -> str:
    if not re.fullmatch(r"1\.[1-9]?[0-9]", text):
        raise ValueError("a version of the protocol is needed, such as 1.20")
    return text


@dataclass(frozen=True, slots=True)
class _Scheme:
    example: str
    build: Callable[[SplitResult, dict[str, Any], str | None], Link]
    parameters: Mapping[str, Callable[[str], Any]]


def _serial(parts: SplitResult, parameters: dict[str, Any], name: str | None) -> Link:
    return SerialLink(_path(parts), name=name, **parameters)


def _rfc2217(parts: SplitResult, parameters: dict[str, Any], name: str | None) -> Link:
    return Rfc2217Link(_host(parts), _port(parts), name=name, **parameters)


def _tcp(parts: SplitResult, parameters: dict[str, Any], name: str | None) -> Link:
    key = parameters.pop("key_file", None)
    if parameters.pop("listen", False):
        if key is not None:
            raise ValueError("key_file does not go with listen")
        return TcpListenLink(parts.hostname or LOOPBACK, _port(parts), name=name, **parameters)
    if "peers" in parameters:
        raise ValueError("peers goes with listen=1 alone: a connection made by the gateway has one other end")
    return _signed(TcpLink(_host(parts), _port(parts), name=name), key)


def _udp(parts: SplitResult, parameters: dict[str, Any], name: str | None) -> Link:
    key = parameters.pop("key_file", None)
    return _signed(UdpLink(parts.hostname or LOOPBACK, _port(parts), name=name, **parameters), key)


def _signed(link: LiveLink, key: bytes | None) -> Link:
    return link if key is None else SignedLink(link, key)


def _slcan(parts: SplitResult, parameters: dict[str, Any], name: str | None) -> Link:
    path = _path(parts)
    stream = SerialLink(path, baud=parameters.pop("baud", DEFAULT_BAUD), name=name or f"slcan://{path}")
    return SlcanLink(stream, name=name, **parameters)


def _can(parts: SplitResult, parameters: dict[str, Any], name: str | None) -> Link:
    channel = unquote(parts.path).strip("/")
    if not parts.netloc or not channel:
        raise ValueError("an interface and a channel are needed")
    if parts.netloc == "socketcan":
        parameters.pop("data_bitrate", None)  # set with the interface by the system, as is bitrate
        return SocketCanLink(channel, name=name, **parameters)
    return CanLink(parts.netloc, channel, name=name, **parameters)


def _marker_file(parts: SplitResult, parameters: dict[str, Any], name: str | None) -> Link:
    return MarkerFileLink(_path(parts), name=name, **parameters)


def _qtm(parts: SplitResult, parameters: dict[str, Any], name: str | None) -> Link:
    if parts.port is None:
        return QtmLink(_host(parts), name=name, **parameters)
    return QtmLink(_host(parts), _port(parts), name=name, **parameters)


def _recording(parts: SplitResult, parameters: dict[str, Any], name: str | None) -> Link:
    return ReplayLink(_path(parts), name=name, **parameters)


_CAN_PARAMETERS = {"bitrate": _whole_number, "fd": _flag, "data_bitrate": _whole_number}
_TCP_PARAMETERS = {"key_file": _key, "listen": _flag, "peers": _networks}
_SHOWN = 80
"""Characters of an address that are repeated in an error."""

_SCHEMES = {
    "serial": _Scheme("serial:///dev/ttyUSB0?baud=1000000", _serial, {"baud": _whole_number}),
    "rfc2217": _Scheme("rfc2217://host:port?baud=1000000", _rfc2217, {"baud": _whole_number}),
    "tcp": _Scheme("tcp://host:port", _tcp, _TCP_PARAMETERS),
    "socket": _Scheme("socket://host:port", _tcp, _TCP_PARAMETERS),
    "udp": _Scheme("udp://host:port", _udp, {"peers": _networks, "key_file": _key}),
    "slcan": _Scheme(
        "slcan:///dev/ttyACM0?bitrate=1000000&fd=1", _slcan, {"baud": _whole_number, **_CAN_PARAMETERS}
    ),
    "can": _Scheme("can://socketcan/can0?fd=1", _can, _CAN_PARAMETERS),
    "markers": _Scheme("markers:///path/walk.c3d?speed=1", _marker_file, {"speed": speed_from}),
    "qtm": _Scheme("qtm://host:22223", _qtm, {"version": _version}),
    "recording": _Scheme("recording:///path.mcap?speed=max", _recording, {"speed": speed_from, "link": str}),
}


def _parameters(query: str, scheme: _Scheme) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in scheme.parameters:
            raise ValueError(f"unknown parameter '{key}'{nearest(key, scheme.parameters)}")
        if key in values:
            raise ValueError(f"parameter '{key}' is given twice")
        try:
            values[key] = scheme.parameters[key](text)
        except ValueError as error:
            raise ValueError(f"{key}={text}: {error}") from error
    return values


def _path(parts: SplitResult) -> str:
    if parts.netloc:
        raise ValueError("a path on this computer begins with a third slash")
    if parts.path in ("", "/"):
        raise ValueError("the path is missing")
    return unquote(parts.path)


def _host(parts: SplitResult) -> str:
    if not parts.hostname:
        raise ValueError("the host is missing")
    return parts.hostname


def _port(parts: SplitResult) -> int:
    if parts.path not in ("", "/"):
        raise ValueError(f"'{parts.path}' after the port means nothing")
    if parts.port is None:  # raises ValueError itself when it is no number up to 65535
        raise ValueError("the port is missing")
    return parts.port


def _unknown_scheme(url: str, scheme: str) -> str:
    if not scheme and url.startswith(("./", "../", "~/")):
        return f"'{url}': write the whole path: {os.path.abspath(os.path.expanduser(url))}"
    if not scheme:
        examples = ", ".join(known.example for known in _SCHEMES.values())
        return f"'{url[:_SHOWN]}' is neither a path (/dev/ttyUSB0) nor a URL; write one like: {examples}"
    return f"{url[:_SHOWN]}: unknown scheme '{scheme[:_SHOWN]}'{nearest(scheme, _SCHEMES)}"


@dataclass(frozen=True, slots=True)
class UartRate:
    """A serial port, 8N1."""

    baud: int


@dataclass(frozen=True, slots=True)
class CanRate:
    """A CAN bus; ``data_bitrate`` None: classic CAN."""

    bitrate: int
    data_bitrate: int | None


def line_rate(url: str) -> UartRate | CanRate | None:
    """Return the rate of a valid endpoint's line; None where there is none (network, pty, recording).

    What the endpoint leaves open is taken as 1 Mbaud, 1 Mbit/s and 2 Mbit/s in the data phase of CAN FD.
    """
    parts = urlsplit(url)
    parameters = dict(parse_qsl(parts.query))
    if parts.scheme in _SERIAL:
        # A pseudo-terminal has no line whose rate would matter.
        if parts.scheme != "rfc2217" and os.path.realpath(parts.path).startswith("/dev/pts/"):
            return None
        return UartRate(int(parameters.get("baud", DEFAULT_BAUD)))
    if parts.scheme in _CAN:
        has_fd = parameters.get("fd", "0") not in {"0", "false", "no"}
        data = int(parameters.get("data_bitrate", DEFAULT_DATA_BITRATE)) if has_fd else None
        return CanRate(int(parameters.get("bitrate", DEFAULT_BITRATE)), data)
    return None
