"""Files that a configuration names: whether each is there, and is what it should be. Opens no port."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from pydantic import BaseModel

from devices.link import LinkError
from devices.links.marker_file_link import MarkerFileLink
from devices.replay_link import ReplayLink
from gateway.body.robot import load_robot
from gateway.body.skeleton import WornSuit
from gateway.cameras.broker_link import link_of
from gateway.clocks import load_clock_table
from gateway.errors import GatewayError
from gateway.outputs.connection import check_files
from gateway.service.further_bodies import further_bodies
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings

_FOLDER = "folder"
"""What settings of folders are called; other paths are of files that are read."""


def trouble_with_files(settings: GatewaySettings, suit: WornSuit, config: Path) -> Iterator[str]:
    """Yield a line for each file, link or folder that ``run`` could not use: field, value and remedy."""
    missing = list(_unreadable(settings, ()))
    yield from missing
    recording = settings.recording
    is_meant = "folder" in recording.model_fields_set or recording.at_start or recording.when_cut_off
    if is_meant and (reason := _unwritable(Path(recording.folder))) is not None:
        yield f"'recording.folder' is {recording.folder}: {reason}"
    for link in settings.links:
        yield from _complaint(partial(_look_at_link, link, settings))
    yield from _complaint(lambda: further_bodies(settings, config))
    if settings.clock.table is not None:
        table = Path(settings.clock.table)
        if (reason := _unreadable_file(table)) is not None:
            yield f"'clock.table' is {table}: {reason}"
        else:
            yield from _complaint(lambda: load_clock_table(table))
    # What a file holds says nothing more where one of them is not there.
    if not missing:
        yield from _wrong_content(settings, suit)


def _wrong_content(settings: GatewaySettings, suit: WornSuit) -> Iterator[str]:
    mqtt, robot = settings.mqtt, settings.outputs.retarget
    yield from _complaint(partial(check_files, mqtt), "'mqtt': ")
    if mqtt.broker == "embedded":
        yield from _complaint(mqtt.read_websocket_token, "'mqtt.websocket_token_file': ")
    if settings.metrics.port is not None:
        yield from _complaint(settings.metrics.token, "'metrics': ")
    if robot is not None:
        yield from _complaint(
            lambda: load_robot(robot.robot, suit.skeleton, robot.urdf), "'outputs.retarget': "
        )


def _look_at_link(link: LinkSettings, settings: GatewaySettings) -> None:
    """Make a link, not opened: an address that makes no sense is found without any hardware."""
    made = link_of(link, settings.mqtt, lambda: settings.mqtt.port)
    if isinstance(made, ReplayLink | MarkerFileLink) and (reason := _unreadable_file(made.path)) is not None:
        raise GatewayError(f"link '{link.name}': url: {made.path}: {reason}")


def _complaint(look: Callable[[], object], before: str = "") -> Iterator[str]:
    """Yield what is wrong by ``look``, if anything."""
    try:
        look()
    except (GatewayError, LinkError) as error:
        yield f"{before}{error}"


def _unreadable(model: BaseModel, place: tuple[str, ...]) -> Iterator[str]:
    """Yield the files among settings that cannot be read, and the folders that cannot be written."""
    for name, value in model:
        if isinstance(value, BaseModel):
            yield from _unreadable(value, (*place, name))
        elif isinstance(value, Path):
            reason = _unwritable(value) if name == _FOLDER else _unreadable_file(value)
            if reason is not None:
                yield f"'{'.'.join((*place, name))}' is {value}: {reason}"


def _unreadable_file(path: Path) -> str | None:
    """Return why a file cannot be read, and what to do; None where it can."""
    try:
        with path.open("rb") as file:
            file.read(1)
    except FileNotFoundError:
        return f"no such file (seen from {Path.cwd()}): correct the path, or make the file"
    except IsADirectoryError:
        return "a folder: name the file in it"
    except PermissionError:
        return f"not readable for this user: sudo chown $USER {path}, or name another file"
    except (OSError, ValueError) as error:
        return f"cannot be read ({error}): name another file"
    return None


def _unwritable(folder: Path) -> str | None:
    """Return why no file can be made in a folder, which may be made later; None where it can."""
    # What counts of one that is not there yet is the deepest folder above it that is.
    folder = folder.absolute()
    present = next(each for each in (folder, *folder.parents) if each.exists())
    try:
        if not present.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        with tempfile.TemporaryFile(dir=present):
            pass
    except OSError as error:
        return f"{present} cannot be written ({error.strerror}): name a folder that this user may write"
    return None
