"""CAN interfaces of the kernel: there, up, at the right bit rate, without errors."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from devices.line_rate import DEFAULT_BITRATE, CanRate, line_rate
from gateway.doctor.findings import Finding, Surroundings, bad, good, warning
from gateway.sources.link_settings import LinkSettings

_WIRING = "check bit rate, the two 120 Ω terminators, and that CAN high and low are not exchanged"
_WORRYING = frozenset({"ERROR-WARNING", "ERROR-PASSIVE"})


def can_interface(link: LinkSettings, surroundings: Surroundings) -> Iterator[Finding]:
    """What the kernel says of the interface that a ``can://socketcan/…`` link names."""
    parts = urlsplit(link.url)
    if parts.scheme != "can" or parts.netloc != "socketcan":
        return
    interface = parts.path.strip("/")
    subject = f"{link.name}: CAN"
    if not (surroundings.sysfs / "class" / "net" / interface).exists():
        yield bad(subject, f"there is no interface {interface}", "plug the CAN adapter in, or correct url")
        return
    rate = line_rate(link.url)
    assert isinstance(rate, CanRate)
    up = _up_command(interface, rate)
    if _read(surroundings, interface, "flags", base=16) & 1 == 0:
        yield bad(subject, f"{interface} is down", up)
        return
    details = _details(surroundings.describe_interface(interface))
    if details:
        has_rate = "bitrate" in dict(parse_qsl(parts.query))
        troubles = list(_troubles(subject, interface, details, rate, has_rate, up))
        yield from troubles or [good(subject, f"{interface} is up{_speed(details)}")]
    else:
        yield good(subject, f"{interface} is up")


def _troubles(
    subject: str, interface: str, details: dict[str, Any], rate: CanRate, has_rate: bool, up: str
) -> Iterator[Finding]:
    state = details.get("state")
    again = f"sudo ip link set {interface} down; {up}"
    if state == "BUS-OFF":
        yield bad(subject, f"{interface} is bus-off: too many errors", f"{_WIRING}; then: {again}")
    elif state in _WORRYING:
        yield warning(subject, f"{interface} is {str(state).lower()}: many errors", _WIRING)
    actual = details.get("bittiming", {}).get("bitrate")
    if has_rate and actual is not None and actual != rate.bitrate:
        found = f"{interface} runs at {actual:,} bit/s, the configuration says {rate.bitrate:,}"
        yield bad(subject, found, f"{again}; or correct bitrate in url")
    data = details.get("data_bittiming", {}).get("bitrate")
    if rate.data_bitrate is not None and data is None and "bittiming" in details:
        yield bad(subject, f"{interface} is up without CAN FD, the configuration says fd=1", again)


def _speed(details: dict[str, Any]) -> str:
    bitrate = details.get("bittiming", {}).get("bitrate")
    return f" at {bitrate:,} bit/s" if bitrate else ""


def _up_command(interface: str, rate: CanRate) -> str:
    data = f" dbitrate {rate.data_bitrate} fd on" if rate.data_bitrate else ""
    bitrate = rate.bitrate or DEFAULT_BITRATE
    return f"sudo ip link set {interface} up type can bitrate {bitrate}{data} restart-ms 100"


def _read(surroundings: Surroundings, interface: str, attribute: str, base: int) -> int:
    try:
        return int((surroundings.sysfs / "class" / "net" / interface / attribute).read_text(), base)
    except (OSError, ValueError):
        return 0


def _details(described: str | None) -> dict[str, Any]:
    """The part about CAN of what ``ip -details -json`` says; empty for an interface that has none."""
    try:
        (interface,) = json.loads(described or "[]")
        found = interface["linkinfo"]["info_data"]
    except (ValueError, KeyError, TypeError):
        return {}
    return found if isinstance(found, dict) else {}
