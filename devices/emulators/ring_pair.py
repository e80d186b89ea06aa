"""The chain of ``ring_chain5`` as the files of two sources: ``python -m devices.emulators.ring_pair TRIAL
FOLDER``.

Five links carry four markers and a module each. Written are ``ring.trc`` (markers), ``ring_set.yaml`` (a
marker set for the shipped body ``chain_5``), ``imu.csv`` (the modules' samples), ``columns.yaml`` (what its
columns are) and ``ring_rig.yaml``: all that the commands of docs/guide/compare.md take.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

from devices.emulators.bodies import FloatArray

MARKER_HZ, MODULE_HZ = 30, 40
ALONG = {1: (2, 4), 2: (2, 4), 3: (1, 3), 4: (2, 3), 5: (4, 2)}
ACROSS = {1: (1, 2), 2: (1, 2), 3: (2, 3), 4: (4, 3), 5: (1, 4)}
"""By segment: markers in whose direction its x and y axis point."""
MODULE_M = {1: 0.0, 2: 0.196, 3: 0.184, 4: 0.173, 5: 0.174}
"""From the segment's joint to its module, which sits in the middle of its markers."""


def write_files(trial: Path, folder: Path) -> None:
    """Write all of them. trial: folder of the recording's trial; folder: made if absent. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    _write_trc(folder / "ring.trc", *_markers(trial))
    (folder / "ring_set.yaml").write_text(_marker_set())
    shutil.copyfile(trial / "imu_rigid.csv", folder / "imu.csv")
    (folder / "columns.yaml").write_text(_columns())
    (folder / "ring_rig.yaml").write_text(_rig())


def _markers(trial: Path) -> tuple[list[str], FloatArray]:
    """Return labels, and places (F, 20, 3), m; NaN where the set has no orientation of the segment."""
    path = trial / "omc.csv"
    names = path.read_text().splitlines()[2].split(",")
    table = np.genfromtxt(path, delimiter=",", skip_header=3)
    labels = [_marker(segment, k) for segment in ALONG for k in range(1, 5)]
    places = np.stack([table[:, [names.index(f"{label}_{a}") for a in "xyz"]] for label in labels], axis=1)
    for row, label in enumerate(labels):
        known = np.isfinite(table[:, names.index(f"{label.partition('_')[0]}_quat_w")])
        places[~known, row] = np.nan
    return labels, places


def _marker(segment: int, k: int) -> str:
    return f"seg{segment}_marker{k}"


def _write_trc(path: Path, labels: list[str], places: FloatArray) -> None:
    n = len(places)
    numbers = "\t".join(f"X{k}\tY{k}\tZ{k}" for k in range(1, len(labels) + 1))
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{MARKER_HZ}\t{MARKER_HZ}\t{n}\t{len(labels)}\tm\t{MARKER_HZ}\t1\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + numbers,
        "",
    ]
    for k, row in enumerate(places):
        cells = ["" if np.isnan(value) else f"{value:.6f}" for value in row.ravel()]
        lines.append("\t".join([str(k + 1), f"{k / MARKER_HZ:.6f}", *cells]))
    path.write_text("\n".join(lines) + "\n")


def _marker_set() -> str:
    lines = ["name: ring", "body: chain_5", f"vertical: [[{_marker(1, 1)}], [{_marker(1, 2)}]]", "markers:"]
    lines += [f"  segment_{s}: [{_all_of(s)}]" for s in ALONG]
    lines.append("points:")
    for s, (begin, end) in ALONG.items():
        lines.append(f"  middle_{s}: {{midpoint: [{_all_of(s)}]}}")
        back = f"along: [{_marker(s, end)}, {_marker(s, begin)}], by: {MODULE_M[s]}"
        if s > 1:
            lines.append(f"  joint_{s}: {{shifted: {{point: middle_{s}, {back}}}}}")
    lines.append("segments:")
    for s, (begin, end) in ALONG.items():
        origin = f"joint_{s}" if s > 1 else "middle_1"
        tip = f", tip: joint_{s + 1}" if s + 1 in ALONG else ""
        along = f"primary: [x, {_marker(s, begin)}, {_marker(s, end)}]"
        across = f"secondary: [y, {', '.join(_marker(s, k) for k in ACROSS[s])}]"
        lines.append(f"  segment_{s}: {{origin: {origin}{tip}, trust_mm: 100, axes: {{{along}, {across}}}}}")
    return "\n".join(lines) + "\n"


def _all_of(segment: int) -> str:
    return ", ".join(_marker(segment, k) for k in range(1, 5))


def _columns() -> str:
    lines = [f"rate_hz: {MODULE_HZ}", "modules:"]
    for s in ALONG:
        columns = {what: ", ".join(f"seg{s}_{what}_{a}" for a in "xyz") for what in ("acc", "gyr", "mag")}
        lines += [
            f"  - name: segment_{s}",
            f"    specific_force: {{columns: [{columns['acc']}], unit: m/s²}}",
            f"    angular_rate: {{columns: [{columns['gyr']}], unit: rad/s}}",
            f"    magnetic_field: {{columns: [{columns['mag']}]}}",
        ]
    return "\n".join(lines) + "\n"


def _rig() -> str:
    modules = [f"  - {{id: {s - 1}, segment: segment_{s}, position: [{MODULE_M[s]}, 0, 0]}}" for s in ALONG]
    world = "world: {gravity: 9.81, magnetic_field: {norm_ut: 50, dip_deg: 65, declination_deg: 0}}"
    return "\n".join(["body: chain_5", "modules:", *modules, world]) + "\n"


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python -m devices.emulators.ring_pair TRIAL FOLDER")
    write_files(Path(sys.argv[1]), Path(sys.argv[2]))
