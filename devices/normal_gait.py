"""Published joint angles of walking: what the emulated person walks by, and analyses show beside others."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

NORMAL_GAIT_FILE = Path(__file__).with_name("normal_gait.csv")
"""Says where its numbers come from."""
SOURCE = "Schwartz et al. 2008, free speed, 83 people of 4 to 17 years"


@cache
def normal_gait() -> dict[str, NDArray[np.float64]]:
    """Published angles by name: (51, 3) percent of the stride, mean and standard deviation, degrees."""
    lines = [line for line in NORMAL_GAIT_FILE.read_text().splitlines() if not line.startswith("#")]
    columns = dict(
        zip(lines[0].split(","), np.array([line.split(",") for line in lines[1:]], float).T, strict=True)
    )
    names = [name.removesuffix("_mean") for name in columns if name.endswith("_mean")]
    return {
        name: np.stack([columns["percent"], columns[f"{name}_mean"], columns[f"{name}_sd"]], axis=1)
        for name in names
    }
