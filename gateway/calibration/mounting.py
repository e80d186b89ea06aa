"""How modules sit, as data: in events of a recording, in rig files, and in the history of rig files."""

from __future__ import annotations

import re
from collections.abc import Collection
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gateway.body.rig import RigFile
from gateway.calibration.body_result import ModuleResult
from gateway.calibration.rig_file import write_rig
from gateway.errors import GatewayError
from gateway.support.settings_files import load_settings, load_yaml, shipped_folder
from gateway.support.whole_files import write_whole, writing

_DATE = r"\d{8}T\d{6}Z"


def mounting_event(modules: Collection[ModuleResult]) -> dict[str, Any]:
    """Return the data of a ``calibrated`` event: by segment, numbers that JSON keeps to the last bit."""
    return {
        "modules": {
            module.segment: {
                "sensor_to_segment": module.sensor_to_segment.tolist(),
                "position": module.position.tolist(),
            }
            for module in modules
            if module.sensor_to_segment is not None
        }
    }


def write_mounted_rig(source: Path, target: Path, modules: Collection[ModuleResult]) -> Path | None:
    """Return the rig of ``source`` with its modules as found, as ``target``; an older one goes to the
    history.

    Where the older one is now; None when there was none. Raises ``SettingsError`` for a bad rig,
    ``GatewayError`` when a file cannot be written.
    """
    found = {module.module: module for module in modules}

    def change(entry: dict[str, Any]) -> None:
        module = found.get(entry["id"])
        if module is not None and module.sensor_to_segment is not None:
            entry["sensor_to_segment"] = [round(float(v), 6) for v in module.sensor_to_segment]
            entry["position"] = [round(float(v), 4) for v in module.position]

    load_settings(source, RigFile)
    content: dict[str, Any] = load_yaml(source)
    instant = datetime.now(UTC)
    kept = keep(target, instant)
    head = f"# {source.name} with its modules as worn, calibrated {instant:%Y-%m-%d %H:%M} UTC.\n"
    write_rig(source, target, content, change, head)
    return kept


def worn_rig(source: Path) -> Path:
    """Return where a calibration of this rig goes by default: the file itself, but never a shipped one."""
    is_shipped = shipped_folder().resolve() in source.resolve().parents
    return Path(f"{source.stem}.worn.yaml") if is_shipped else source


def history_folder(rig: Path) -> Path:
    """Return where earlier versions of a rig file are."""
    return rig.with_name(f"{rig.stem}.history")


def keep(rig: Path, now: datetime) -> Path | None:
    """Copy a rig file into its history, named by the instant; None when there is no such file."""
    if not rig.is_file():
        return None
    folder = history_folder(rig)
    copy = folder / f"{now:%Y%m%dT%H%M%SZ}.yaml"
    try:
        folder.mkdir(exist_ok=True)
        number = 1
        while copy.exists():
            number += 1
            copy = folder / f"{now:%Y%m%dT%H%M%SZ}_{number}.yaml"
        write_whole(copy, rig.read_bytes())
    except OSError as error:
        raise GatewayError(f"{copy}: the earlier rig cannot be kept: {error.strerror}") from error
    return copy


def history(rig: Path) -> list[Path]:
    """Return earlier versions of a rig file, newest first."""
    pattern = re.compile(rf"^{_DATE}(_\d+)?\.yaml$")
    folder = history_folder(rig)
    if not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if pattern.match(path.name)), reverse=True)


def restore(rig: Path, version: str | None = None) -> Path:
    """Put an earlier version back, the newest one or the one named; what is there now is kept too.

    Which one it was. Raises ``GatewayError`` when there is none.
    """
    versions = history(rig)
    chosen = [path for path in versions if version is None or path.stem == version]
    if not chosen:
        there = ", ".join(path.stem for path in versions) or "none"
        wanted = "no earlier version" if version is None else f"no version '{version}'"
        raise GatewayError(f"{rig} has {wanted} in {history_folder(rig).name}/ (there: {there})")
    content = chosen[0].read_bytes()
    keep(rig, datetime.now(UTC))
    with writing(rig):
        write_whole(rig, content)
    return chosen[0]
