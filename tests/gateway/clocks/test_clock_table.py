"""Mode 1: the source's procedure on an example worked by hand; storage; the clock that uses it."""

import numpy as np
import pytest

from gateway.clocks import (
    ClockCalibration,
    ClockTable,
    TableClocks,
    clock_table,
    load_clock_table,
    save_clock_table,
)
from gateway.errors import GatewayError, SettingsError


def test_worked_example_by_hand():
    """Three modules, three minutes, measured twice.

    By the slowest (7) at k = 1, 2, 3 minutes module 3 has counted 1.0001, 2.0003, 3.0006 minutes the first
    time and 1.0003, 2.0005, 3.0006 the second. The means are 1.0002, 2.0004, 3.0006, so
    α_{3,1} = 1 / 1.0002 = 0.99980004, α_{3,2} = 2 / 2.0004 = 0.99980004, α_{3,3} = 3 / 3.0006 = 0.99980004.
    Module 5: 1.00001 and 1.00003, mean 1.00002: α_{5,1} = 0.99998; 2.0000, 2.0002, mean 2.0001:
    α_{5,2} = 2 / 2.0001 = 0.99995; 3.0003: α_{5,3} = 0.99990.
    """
    first = {3: [1.0001, 2.0003, 3.0006], 5: [1.00001, 2.0000, 3.0003], 7: [1.0, 2.0, 3.0]}
    second = {3: [1.0003, 2.0005, 3.0006], 5: [1.00003, 2.0002, 3.0003], 7: [1.0, 2.0, 3.0]}
    table = clock_table([first, second])
    assert table.reference == 7
    assert table.ranking == (7, 5, 3)  # slowest first
    np.testing.assert_allclose(table.alpha[7], 1.0)
    np.testing.assert_allclose(table.alpha[3], 0.99980004, atol=1e-8)
    np.testing.assert_allclose(table.alpha[5], [0.9999800004, 0.9999500025, 0.9999000100], atol=1e-9)
    # 60.0012 s counted by module 5 are one minute of the reference; 90.0021 s lie in the middle of its second
    # minute (60.0012 to 120.006 s), which is a minute and 30.0 s
    assert table.reference_us(5, 60_001_200) == pytest.approx(60e6, abs=1)
    assert table.reference_us(5, 90_003_600) == pytest.approx(90e6, abs=1)
    # after the table's end the last minute's rate: 60.012 s of the module are a minute
    assert table.reference_us(5, 180_018_000 + 60_012_000) == pytest.approx(240e6, abs=10)
    assert table.reference_us(7, 12_345_678) == pytest.approx(12_345_678)
    assert table.reference_us(99, 5.0) == 5.0
    assert table.skew_ppm(3) == pytest.approx(200.0, abs=0.1)


def test_a_table_survives_its_file(tmp_path):
    table = clock_table([{1: [1.0, 2.0], 2: [1.00005, 2.0001]}], interval_s=30.0)
    save_clock_table(table, tmp_path / "suit.clocks.yaml")
    again = load_clock_table(tmp_path / "suit.clocks.yaml")
    assert (again.reference, again.ranking, again.interval_s) == (1, (1, 2), 30.0)
    np.testing.assert_allclose(again.alpha[2], table.alpha[2], atol=1e-10)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("reference: 1\nranking: [1]\nalpha: {1: [1.0], 2: [1.0]}\n", "must name the same modules"),
        ("reference: 1\nranking: [1, 2]\nalpha: {1: [1.0], 2: [1.0, 1.0]}\n", "same number of entries"),
        ("reference: 1\nranking: [1]\nalpha: {1: [60.0]}\n", "not near 1"),
        ("reference: 1\nrankin: [1]\nalpha: {1: [1.0]}\n", "did you mean 'ranking'"),
    ],
)
def test_a_bad_table_is_named(tmp_path, text, said):
    (tmp_path / "table.yaml").write_text(text)
    with pytest.raises(SettingsError, match=said):
        load_clock_table(tmp_path / "table.yaml")


def test_counts_that_do_not_agree_are_refused():
    with pytest.raises(ValueError, match="same modules"):
        clock_table([{1: [1.0], 2: [1.0, 2.0]}])


PPM = {4: -60.0, 9: 15.0, 2: 80.0}


def arrivals(seconds, seed=1, rate_hz=50.0, ppm=PPM):
    """(arrived ns, module, stamp, true µs) of all modules in order of arrival."""
    out = []
    for module, skew in ppm.items():
        rng = np.random.default_rng([seed, module])
        true_us = np.arange(seconds * rate_hz) * 1e6 / rate_hz + rng.uniform(0, 2e4)
        stamps = np.round(true_us * (1 + skew * 1e-6)).astype(np.int64) + int(rng.integers(2**32))
        at = true_us + 500 + rng.exponential(500, len(true_us))
        out += zip(
            (at * 1e3).astype(np.int64).tolist(),
            [module] * len(at),
            (stamps % 2**32).tolist(),
            true_us,
            strict=True,
        )
    return sorted(out)


def test_calibration_ranks_the_modules_and_finds_their_rates():
    calibration = ClockCalibration(tuple(PPM), minutes=3, repetitions=2, minute_s=20.0, settling_s=5.0)
    for at, module, stamp, _ in arrivals(calibration.duration_s + 1):
        calibration.observe(module, stamp, at)
    assert calibration.is_complete
    table = calibration.table()
    assert table.ranking == (4, 9, 2)
    assert table.repetitions == 2
    for module, ppm in PPM.items():
        assert table.skew_ppm(module) == pytest.approx(ppm + 60, abs=1.5)
        assert len(table.alpha[module]) == 3


def test_calibration_names_silent_modules_and_too_short_ones():
    calibration = ClockCalibration((4, 9, 2, 11), minutes=1, minute_s=5.0, settling_s=1.0)
    for at, module, stamp, _ in arrivals(3):
        calibration.observe(module, stamp, at)
    with pytest.raises(GatewayError, match="modules 11 of the rig were not heard"):
        calibration.table()
    short = ClockCalibration(tuple(PPM), minutes=1, minute_s=5.0, settling_s=1.0)
    for at, module, stamp, _ in arrivals(4):
        short.observe(module, stamp, at)
    with pytest.raises(GatewayError, match="that were to be measured"):
        short.table()


def test_table_clocks_hold_together_by_the_table_alone():
    interval = 60.0
    alpha = {m: np.full(3, (1 + PPM[4] * 1e-6) / (1 + ppm * 1e-6)) for m, ppm in PPM.items()}
    clocks = TableClocks(ClockTable(4, (4, 9, 2), interval, alpha))
    used = {module: clocks.clock(module) for module in PPM}
    errors = {module: [] for module in PPM}
    for at, module, stamp, true_us in arrivals(300, seed=3):
        instant = used[module].gateway_time(stamp, at)
        assert instant <= at + 1000
        if true_us > 60e6:
            errors[module].append(instant * 1e-3 - true_us - 500)
    means = [np.mean(e) for e in errors.values()]
    assert np.abs(means).max() < 60
    assert max(np.abs(e).max() for e in errors.values()) < 150
    for module, ppm in PPM.items():
        assert used[module].figures().skew_ppm == pytest.approx(ppm, abs=2)
