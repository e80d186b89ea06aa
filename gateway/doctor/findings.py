"""What a finding is, and the parts of the system that findings rest on."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from devices.links.serial_ports import BY_ID
from gateway.support.whole_files import free_bytes


class Verdict(StrEnum):
    """How bad a finding is."""

    GOOD = "good"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at."""

    subject: str
    verdict: Verdict
    found: str
    remedy: str = ""


def good(subject: str, found: str) -> Finding:
    """Return a finding that asks for nothing."""
    return Finding(subject, Verdict.GOOD, found)


def warning(subject: str, found: str, remedy: str) -> Finding:
    """Return a finding of something that works, but not well or not for long."""
    return Finding(subject, Verdict.WARNING, found, remedy)


def bad(subject: str, found: str, remedy: str) -> Finding:
    """Return a finding of something that will not work."""
    return Finding(subject, Verdict.BAD, found, remedy)


def describe_interface(interface: str) -> str | None:
    """Return what ``ip`` says of a network interface, as JSON; None: no such program, or no such
    interface."""
    program = shutil.which("ip", path="/usr/sbin:/usr/bin:/sbin:/bin")
    if program is None:
        return None
    command = [program, "-details", "-statistics", "-json", "link", "show", "dev", interface]
    done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    return done.stdout if done.returncode == 0 else None


@dataclass(frozen=True)
class Surroundings:
    """The system as the doctor sees it: another one in tests."""

    sysfs: Path = Path("/sys")
    by_id: Path = BY_ID
    describe_interface: Callable[[str], str | None] = describe_interface
    free_bytes: Callable[[Path], int] = free_bytes
    usual_broker_ports: tuple[int, ...] = (1883, 8883)
    """Where a broker is looked for that does not answer where it should."""
