"""What a muscle has left of its largest force, away from its best length and while it moves."""

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("osqp")
pytest.importorskip("myo_sim")

from gateway.analysis.analysing import analyse_motion
from gateway.analysis.muscle_curves import LEAST_SHARE, Curves, force_shares
from gateway.analysis.muscle_model import muscle_model
from gateway.analysis.muscle_paths import MusclePaths
from gateway.analysis.muscle_settings import load_costs
from gateway.analysis.muscles import find_muscles
from gateway.analysis.smooth_motion import smooth_motion
from gateway.body.body_file import load_body
from gateway.body.inertia import body_inertia

BODY = load_body("human_17")
GRAVITY = np.array([0.0, 0.0, -9.81])
TIME_S = np.arange(5) * 0.01


@pytest.fixture(scope="module")
def paths():
    return MusclePaths(BODY, muscle_model())


@pytest.fixture(scope="module")
def best(paths):
    """Wire lengths (W,) at which fibres have their best length, and those best lengths (W,), m."""
    ranges = np.array([wire.length_range for wire in paths.wires])
    gains = np.array([wire.gain for wire in paths.wires])
    fibre = (ranges[:, 1] - ranges[:, 0]) / (gains[:, 1] - gains[:, 0])
    still = np.tile([1.0, 0.0, 0.0, 0.0], (BODY.n_segments, 1))
    paths.place(np.zeros(3), still, {"left_": 0.0, "right_": 0.0})
    size = paths.lengths() / np.array([wire.standing_length_m for wire in paths.wires])
    return size * (ranges[:, 0] + (1.0 - gains[:, 0]) * fibre), size * fibre


def test_at_its_best_length_and_at_rest_a_muscle_has_all_its_force(paths, best):
    still = np.tile(best[0], (5, 1))
    for curves in Curves:
        assert force_shares(paths, still, TIME_S, curves) == pytest.approx(1.0, abs=1e-9)


def test_away_from_its_best_length_it_has_less_and_none_where_it_cannot_be(paths, best):
    for factor in (0.7, 1.3):
        away = np.tile(best[0] + (factor - 1.0) * best[1], (5, 1))
        assert (force_shares(paths, away, TIME_S, Curves.LENGTH) < 1.0).all()
    far = np.tile(best[0] + 3.0 * best[1], (5, 1))
    assert force_shares(paths, far, TIME_S, Curves.LENGTH) == pytest.approx(LEAST_SHARE)


def test_while_it_shortens_it_has_less_and_while_it_lengthens_more(paths, best):
    for rate, compare in ((-1.0, np.less), (1.0, np.greater)):  # best lengths a second
        moving = best[0] + rate * (TIME_S - TIME_S[2])[:, None] * best[1]
        middle = force_shares(paths, moving, TIME_S, Curves.LENGTH_VELOCITY)[2]
        assert compare(middle, 1.0).all()
        assert force_shares(paths, moving, TIME_S, Curves.LENGTH)[2] == pytest.approx(1.0, abs=1e-9)


def test_a_measured_force_is_kept_to_whatever_the_curves_say(tmp_path):
    (tmp_path / "force.csv").write_text("time_s,vaslat_l_n\n0,100\n1,100\n")
    (tmp_path / "muscles.yaml").write_text("curves: length\nguide: {file: force.csv, weight: 3000}\n")
    time_s = np.arange(8) / 100
    q_wb = np.tile(BODY.neutral, (8, BODY.n_segments, 1))
    motion = smooth_motion(BODY, time_s, q_wb, np.tile([0.0, 0.0, 0.93], (8, 1)), None)
    found = analyse_motion(motion, "standing", body_inertia(BODY, 70.0), GRAVITY)

    def costs(paths):
        peaks = np.array([wire.peak_force_n for wire in paths.wires])
        return load_costs(tmp_path / "muscles.yaml", tuple(wire.name for wire in paths.wires), peaks, time_s)

    pulled = find_muscles(found, costs)
    w = pulled.names.index("vaslat_l")
    assert pulled.share[4, w] < 0.999
    assert pulled.tension[4, w] == pytest.approx(100.0, rel=0.05)
    assert pulled.tension == pytest.approx(pulled.activity * pulled.largest_force * pulled.share)
