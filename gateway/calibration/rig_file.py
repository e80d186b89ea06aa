"""A rig file with the calibrations of its modules' sensors written into it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml

from devices.calibration import SensorCalibration
from gateway.body.rig import RigFile
from gateway.body.sensor_entries import CalibrationEntry
from gateway.support.settings_files import load_settings, load_yaml
from gateway.support.whole_files import write_whole, writing


def write_calibrated_rig(
    source: Path,
    target: Path,
    calibrations: Mapping[int, SensorCalibration],
    measured: str | None = None,
    dip_deg: float | None = None,
) -> None:
    """Write the rig of ``source`` with these calibrations, by module id, as the file ``target``.

    measured: date for people; none: today. dip_deg: of the local field; none: as it stands there. Raises
    ``SettingsError`` for a bad rig, ``GatewayError`` when the file cannot be written.
    """
    load_settings(source, RigFile)
    content: dict[str, Any] = load_yaml(source)
    if dip_deg is not None:
        field = content.setdefault("world", {}).setdefault("magnetic_field", {})
        field["dip_deg"] = round(dip_deg, 1)
    date = measured or datetime.now(UTC).date().isoformat()

    def change(module: dict[str, Any]) -> None:
        calibration = calibrations.get(module["id"])
        if calibration is not None:
            module["calibration"] = CalibrationEntry.of(calibration, date).model_dump(mode="json")

    write_rig(source, target, content, change, f"# {source.name} with its modules' sensors calibrated.\n")


def write_rig(
    source: Path,
    target: Path,
    content: dict[str, Any],
    change: Callable[[dict[str, Any]], None],
    head: str,
) -> None:
    """Write the content of a rig file, with its modules' entries changed, as ``target``.

    Raises ``GatewayError`` when that cannot be written.
    """
    for module in content["modules"]:
        change(module)
    # A body beside the old file would no longer be found from another folder.
    beside = source.parent / content["body"]
    if beside.is_file() and source.parent.resolve() != target.parent.resolve():
        content["body"] = str(beside.resolve())
    text = head + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    with writing(target):
        write_whole(target, text.encode())
