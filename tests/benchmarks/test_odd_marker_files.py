"""The odd files are as odd as their names say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.odd_marker_files import CASES, LABELS, outcome, write_case
from devices.marker_files import MarkerTrial, read_markers
from devices.vendor_formats.sheets import FormatError

TRIALS = [
    MarkerTrial("t", LABELS, 24.0, np.random.default_rng(0).normal(1.0, 0.4, (n, len(LABELS), 3)))
    for n in (10, 40)
]


REFUSED = {
    "blanks in the place of tabs": "parted by tabs",
    "an empty walk": "is empty",
    "a head without frames": "no frame behind its header",
    "commas in the place of tabs": "parted by tabs",
    "a web page": "not a TRC file",
}
FRAMES = {"frames left out": 25, "one frame": 1}
"""Of those cases whose walk has fewer than it had."""


@pytest.mark.parametrize("case", CASES)
def test_every_file_can_be_read_or_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    _, walk = write_case(tmp_path, case, TRIALS)
    if case in REFUSED:
        with pytest.raises(FormatError, match=REFUSED[case]):
            read_markers(walk)
        return
    found = read_markers(walk)
    assert found.n_frames == FRAMES[case] if case in FRAMES else 30 <= found.n_frames <= 40
    is_faulty = case.startswith(
        (
            "ends",
            "text",
            "miscounted",
            "two points",
            "times",
            "frames left",
            "frames from",
            "one frame",
            "two trials",
            "n/a",
            "-nan",
            "markers lost",
            "no rate",
        )
    )
    assert bool(found.notes) == is_faulty


def test_what_is_refused_says_what_to_do(tmp_path: Path) -> None:
    fits, said = outcome(write_case(tmp_path, "two people", TRIALS))
    assert fits == "refused"
    assert "--person Bob" in said
    assert str(tmp_path) not in said
