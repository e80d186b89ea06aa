"""TRC: joint centres and tips as markers. Text with tabs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gateway.outputs.exporters.take import Take

_UNITS = {1.0: "m", 100.0: "cm", 1000.0: "mm"}


def write(take: Take, path: Path, units_per_m: float) -> None:
    """Markers ``<segment>`` (proximal joint) and ``<segment>_tip``. Raises ``OSError``."""
    names = [*take.skeleton.segment_names, *(f"{name}_tip" for name in take.skeleton.segment_names)]
    points = np.concatenate([take.p_w, take.tips_w], axis=1) * units_per_m
    frames, rate = len(points), f"{take.rate_hz:.6f}"
    unit = _UNITS.get(units_per_m, f"{units_per_m:g}/m")
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{len(names)}\t{unit}\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"X{n}\tY{n}\tZ{n}" for n in range(1, len(names) + 1)),
        "",
    ]
    table = np.column_stack([np.arange(1, frames + 1), take.time_s, points.reshape(frames, -1)])
    with path.open("w", encoding="ascii") as file:
        file.write("\n".join(head) + "\n")
        np.savetxt(file, table, fmt=["%d", *["%.6f"] * (table.shape[1] - 1)], delimiter="\t")
