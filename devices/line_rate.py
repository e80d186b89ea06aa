"""How fast the line behind an endpoint is, as far as its name says."""

from __future__ import annotations

import os
from dataclasses import dataclass
from urllib.parse import parse_qsl, urlsplit

from devices.links.serial_link import DEFAULT_BAUD

DEFAULT_BITRATE = 1_000_000
DEFAULT_DATA_BITRATE = 2_000_000
_SERIAL = frozenset({"", "serial", "rfc2217"})
_CAN = frozenset({"can", "slcan"})


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
