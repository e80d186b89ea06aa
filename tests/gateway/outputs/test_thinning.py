"""Rate limit of the poses."""

from __future__ import annotations

import numpy as np
import pytest

from gateway.outputs.output import Thinning


@pytest.mark.parametrize(
    ("rate", "kept"), [(None, 1000), (200.0, 1000), (100.0, 1000), (30.0, 300), (1.0, 10)]
)
def test_ten_seconds_at_100_hz(rate: float | None, kept: int) -> None:
    thinning = Thinning(rate)
    assert sum(thinning.admits(10_000_000 * i + 7) for i in range(1000)) == kept


def test_jitter_does_not_lower_the_rate() -> None:
    rng = np.random.default_rng(1)
    instants = 10_000_000 * np.arange(2000) + rng.integers(0, 4_000_000, 2000)
    thinning = Thinning(50.0)
    assert sum(thinning.admits(int(t)) for t in instants) == pytest.approx(1000, abs=2)


def test_goes_on_after_a_gap_and_after_time_ran_backwards() -> None:
    thinning = Thinning(10.0)
    assert [thinning.admits(t * 10**6) for t in (0, 50, 5000, 5050, 5100, 20, 70, 120)] == [
        True, False, True, False, True, True, False, True
    ]  # fmt: skip
