"""Which serial ports exist, who holds one, and what to do when one cannot be opened."""

from __future__ import annotations

import errno
import grp
import os
from collections.abc import Iterator
from pathlib import Path

from serial.tools import list_ports

from devices.link import LinkBusyError, LinkError

BY_ID = Path("/dev/serial/by-id")


def serial_ports() -> list[str]:
    """Return the paths of the serial ports present, stable by-id names first, each port once."""
    by_id = sorted(str(path) for path in BY_ID.iterdir()) if BY_ID.is_dir() else []
    named = {os.path.realpath(path) for path in by_id}
    others = sorted(port.device for port in list_ports.comports() if port.device not in named)
    return by_id + others


def open_error(path: str, error: OSError) -> LinkError:
    """Return the error of a port that could not be opened: what was found, and the remedy."""
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO:
            return LinkError(f"{path}: {_absence(path)}; {_ports_present()}")
        case errno.EACCES | errno.EPERM:
            return LinkError(f"{path}: no permission; {_permission_remedy(path)}")
        case errno.EBUSY:
            return LinkBusyError(f"{path} is busy: {port_holder(path)} has it open; stop that and try again")
        case errno.EIO:
            return LinkError(f"{path}: the other end is closed; start the device or emulator behind it")
        case errno.ENOTTY | errno.EISDIR | errno.EINVAL:
            return LinkError(f"{path} is not a serial port; {_ports_present()}")
        case _:
            return LinkError(f"{path} cannot be opened: {error.strerror}; {_ports_present()}")


def port_holder(path: str) -> str:
    """Return the process that has the port locked or open, as far as this user may see."""
    device = os.path.realpath(path)
    holders = list(_lock_holders(device)) or [pid for pid in _open_holders(device) if pid != os.getpid()]
    if not holders:
        return "another process"
    pid = holders[0]
    if pid == os.getpid():
        return "this very process"
    try:
        command = Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return f"process {pid}"
    return f"{command} (process {pid})"


def _lock_holders(device: str) -> Iterator[int]:
    """Yield processes with a lock on the device file, from fields 4 and 5 of /proc/locks: pid and file."""
    try:
        status = os.stat(device)
        locks = Path("/proc/locks").read_text().splitlines()
    except OSError:
        return
    number = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    for line in locks:
        fields = line.split()
        # The line of a process that waits has "->" in it, and does not match; pids 0 and -1 name no process.
        if len(fields) > 5 and fields[5] == number and fields[4].isdigit() and fields[4] != "0":
            yield int(fields[4])


def _open_holders(device: str) -> Iterator[int]:
    for entry in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if os.readlink(entry) == device:
                yield int(entry.parts[2])
        except OSError:
            continue  # gone meanwhile, or another user's


def _absence(path: str) -> str:
    if os.path.islink(path):
        return f"points to {os.path.realpath(path)}, which is not there"
    return "no such port"


def _ports_present() -> str:
    ports = serial_ports()
    return (
        f"ports present: {', '.join(ports)}" if ports else "no serial port is present: plug the receiver in"
    )


def _permission_remedy(path: str) -> str:
    try:
        group = grp.getgrgid(os.stat(path).st_gid).gr_name
    except (OSError, KeyError):
        return "ask the administrator of this computer for access"
    if group == "root":
        return "it belongs to root: add a udev rule that gives it to a group you are in"
    return f"it belongs to group {group}: run 'sudo usermod -aG {group} $USER' and log in again"
