"""Ports: there, permitted, free, under a name that stays, and quick."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

from devices.endpoints import link_from_url
from devices.link import LinkError
from devices.replay_link import ReplayLink
from gateway.doctor.findings import Finding, Surroundings, bad, good, warning
from gateway.sources.link_settings import LinkSettings

LONGEST_LATENCY_MS = 2
_UDEV_RULE = "docker/udev/60-mocap-gateway.rules"
_CHANGING_NAME = re.compile(r"^/dev/tty(USB|ACM)\d+$")
_SERIAL_SCHEMES = frozenset({"", "serial", "slcan"})


async def opening(link: LinkSettings, *, gateway_runs: bool) -> Finding:
    """Whether the port can be opened; it is, for a moment. A running gateway may have it open."""
    subject = f"{link.name}: port"
    opened = link_from_url(link.url, name=link.name)
    try:
        await opened.open()
    except LinkError as error:
        found, _, remedy = str(error).partition("; ")
        if gateway_runs and "is busy" in found:
            return good(subject, f"{link.url} is open in the running gateway")
        return bad(subject, found, remedy or "correct its url in the configuration, or plug it in")
    await opened.close()
    what = "recording can be read" if isinstance(opened, ReplayLink) else "can be opened"
    return good(subject, f"{link.url} {what}")


def device_of(url: str) -> str | None:
    """The path of the device file in an endpoint; None for one that has none."""
    parts = urlsplit(url)
    if parts.scheme not in _SERIAL_SCHEMES or not parts.path.startswith("/dev/"):
        return None
    return parts.path


def naming(link: LinkSettings, surroundings: Surroundings) -> Iterator[Finding]:
    """Whether the port's name will be the same after the next plugging in."""
    device = device_of(link.url)
    if device is None:
        return
    subject = f"{link.name}: name"
    if not _CHANGING_NAME.match(device):
        if "/by-id/" in device or device.startswith("/dev/mocap/"):
            yield good(subject, f"{device} stays the same however it is plugged in")
        return
    names = sorted(surroundings.by_id.iterdir()) if surroundings.by_id.is_dir() else []
    stable = next((str(name) for name in names if _target(name) == device), None)
    remedy = f"write url: {stable}" if stable else f"install {_UDEV_RULE} and use /dev/mocap/<serial number>"
    yield warning(subject, f"{device} may be another adapter after the next plugging in", remedy)


def latency(link: LinkSettings, surroundings: Surroundings) -> Iterator[Finding]:
    """How long the adapter keeps bytes back: FTDI's default is 16 ms."""
    device = device_of(link.url)
    if device is None:
        return
    tty = Path(os.path.realpath(device)).name
    timer = surroundings.sysfs / "class" / "tty" / tty / "device" / "latency_timer"
    try:
        milliseconds = int(timer.read_text())
    except (OSError, ValueError):
        return  # not an adapter that has one
    subject = f"{link.name}: latency"
    if milliseconds <= LONGEST_LATENCY_MS:
        yield good(subject, f"latency_timer of {tty} is {milliseconds} ms")
        return
    yield warning(
        subject,
        f"latency_timer of {tty} is {milliseconds} ms: samples come in clumps, so much later",
        f"echo 1 | sudo tee {timer}; for good: install {_UDEV_RULE}",
    )


def _target(name: Path) -> str:
    """Where a name under by-id leads, as far as it is one link to a device file."""
    try:
        return os.path.normpath(name.parent / name.readlink())
    except OSError:
        return ""
