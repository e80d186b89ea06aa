"""TRC: joint centres and tips as markers, and the markers themselves. Text with tabs."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from gateway.recording.exporters.take import Take, markers_of

_UNITS = {1.0: "m", 100.0: "cm", 1000.0: "mm"}


def write(take: Take, path: Path, units_per_m: float) -> None:
    """Write a take as TRC. Raises ``OSError``.

    Markers are ``<segment>`` (proximal joint), ``<segment>_tip``, then those that the poses were made from,
    by their own names; a cell is empty where one was not seen.
    """
    names = [*take.skeleton.segment_names, *(f"{name}_tip" for name in take.skeleton.segment_names)]
    places = [take.p_w, take.tips_w]
    if (markers := markers_of(take)) is not None:
        names += markers.labels
        places.append(markers.positions)
    points = np.concatenate(places, axis=1) * units_per_m
    frames, rate = len(points), f"{take.rate_hz:.9f}".rstrip("0").rstrip(".")
    # TRC counts frames from one.
    first = 1 + round(take.begins_s * take.rate_hz)
    unit = _UNITS.get(units_per_m, f"{units_per_m:g}/m")
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{len(names)}\t{unit}\t{rate}\t{first}\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"X{n}\tY{n}\tZ{n}" for n in range(1, len(names) + 1)),
        "",
    ]
    table = np.column_stack([np.arange(first, first + frames), take.time_s, points.reshape(frames, -1)])
    with path.open("w", encoding="utf-8") as file:
        file.write("\n".join(head) + "\n")
        for frame, *numbers in table.tolist():
            file.write("\t".join([f"{frame:.0f}", *map(_cell, numbers)]) + "\n")


def _cell(number: float) -> str:
    return "" if math.isnan(number) else f"{number:.6f}"
