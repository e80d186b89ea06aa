"""Wires on the body against their own lengths, and tensions against another solver."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from gateway.analysis.muscle_settings import load_costs
from gateway.analysis.tension import TensionSolver
from gateway.body.body_file import load_body
from gateway.errors import GatewayError

pytest.importorskip("mujoco")
pytest.importorskip("osqp")
pytest.importorskip("myo_sim")

from gateway.analysis.muscle_model import muscle_model
from gateway.analysis.muscle_paths import MusclePaths

BODY = load_body("human_17")
NAMES = BODY.segment_names


@pytest.fixture(scope="module")
def paths():
    return MusclePaths(BODY, muscle_model())


def turned(angle, axis):
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * np.asarray(axis, float)])


def lengths(paths, hip=0.2, knee=0.4, ankle=0.1, bend=0.0):
    """Of all wires; leaves the posture in ``paths``."""
    rotation = np.tile([1.0, 0, 0, 0], (len(NAMES), 1))
    rotation[0] = BODY.neutral
    rotation[NAMES.index("thorax")] = turned(-bend, [0, 0, 1])
    for side in ("left_", "right_"):
        for part, angle in (("thigh", hip), ("shank", -knee), ("foot", ankle)):
            rotation[NAMES.index(side + part)] = turned(angle, [0, 0, 1])
    paths.place(np.array([0.3, -0.2, 0.93]), rotation, {"left_": knee, "right_": knee})
    return paths.lengths()


@pytest.mark.parametrize(
    ("angle", "segments", "sign"),
    [
        ("hip", ("left_thigh", "right_thigh"), 1),
        ("knee", ("left_shank", "right_shank"), -1),
        ("ankle", ("left_foot", "right_foot"), 1),
        ("bend", ("thorax",), -1),
    ],
)
def test_what_a_wire_turns_is_how_it_shortens(paths, angle, segments, sign):
    """Moment arm = − change of length by angle: over both legs together, the patella's way included."""
    step = 1e-5
    base = {"hip": 0.2, "knee": 0.4, "ankle": 0.1, "bend": 0.05}
    change = lengths(paths, **(base | {angle: base[angle] + step})) - lengths(
        paths, **(base | {angle: base[angle] - step})
    )
    lengths(paths, **base)
    arms = sum(sign * paths.moments(NAMES.index(segment))[:, 2] for segment in segments)
    if angle == "knee":
        arms = arms + sum(paths.patella_moments(side, base["knee"]) for side in ("left_", "right_"))
    assert np.abs(arms).max() > 0.03
    assert -change / (2 * step) == pytest.approx(arms, abs=2e-4)


def test_what_muscles_do_is_anatomy(paths):
    lengths(paths)
    names = [wire.name for wire in paths.wires]
    knee = -paths.moments(NAMES.index("right_shank"))[:, 2] + paths.patella_moments("right_", 0.4)
    hip = paths.moments(NAMES.index("right_thigh"))[:, 2]
    ankle = paths.moments(NAMES.index("right_foot"))[:, 2]
    assert -0.06 < knee[names.index("vaslat_r")] < -0.03
    assert 0.02 < knee[names.index("semimem_r")] < 0.07
    assert 0.01 < hip[names.index("psoas_r")] < 0.06
    assert -0.09 < hip[names.index("glmax2_r")] < -0.03
    assert -0.06 < ankle[names.index("soleus_r")] < -0.03
    assert 0.03 < ankle[names.index("tibant_r")] < 0.06
    assert knee[names.index("vaslat_l")] == 0.0


def test_left_and_right_are_mirror_images(paths):
    lengths(paths)
    names = [wire.name for wire in paths.wires]
    length = paths.lengths()
    for i, name in enumerate(names):
        if name.endswith("_r"):
            assert length[i] == pytest.approx(length[names.index(name[:-2] + "_l")], rel=2e-2)


def test_a_body_without_legs_is_told():
    with pytest.raises(GatewayError, match="carries no muscles: it has no pelvis"):
        MusclePaths(load_body("arm_4"), muscle_model())


@pytest.mark.parametrize("seed", range(5))
def test_tensions_are_those_of_another_solver(seed):
    random = np.random.default_rng(seed)
    peak = random.uniform(200, 4000, 30)
    weight, bias = random.uniform(0.5, 4, 30), random.uniform(0, 0.3, 30)
    solver = TensionSolver(peak, 6, weight)
    for _ in range(4):
        arms = random.uniform(-0.06, 0.06, (6, 30))
        torques = (arms * peak) @ random.uniform(0, 1, 30) * 1.3
        activity, left = solver.solve(arms, torques, bias)
        rows = np.vstack([np.diag(np.sqrt(weight)), arms * peak])
        other = lsq_linear(rows, np.concatenate([np.sqrt(weight) * bias, torques]), (0, 1), tol=1e-13)
        assert activity == pytest.approx(other.x, abs=3e-3)
        assert left == pytest.approx(torques - (arms * peak) @ activity, abs=1e-9)


def test_bias_weight_strength_and_guides_are_read(tmp_path):
    (tmp_path / "emg.csv").write_text("time_s,soleus_l,vasmed_l_n\n0.1,0.5,100\n0.3,0.7,\n")
    (tmp_path / "m.yaml").write_text(
        "strength: 0.5\nmuscles:\n- {name: 'vas*_l', weight: 3, bias: 0.1}\n"
        "guide: {file: emg.csv, weight: 9}\n"
    )
    names = ("soleus_l", "vasmed_l", "vasmed_r")
    costs = load_costs(
        tmp_path / "m.yaml", names, np.array([1000.0, 400.0, 400.0]), np.array([0.0, 0.1, 0.2, 0.4])
    )
    assert costs.strength.tolist() == [0.5, 0.5, 0.5]
    assert costs.bias[:, 0] == pytest.approx([0, 0.5, 0.6, 0])
    assert costs.weight[:, 0].tolist() == [1, 9, 9, 1]
    assert costs.bias[:, 1] == pytest.approx([0.1, 0.5, 0.1, 0.1])  # 100 N of 200, at one instant
    assert costs.weight[:, 2].tolist() == [1, 1, 1, 1]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("muscles: [{name: soleuss_l}]", "did you mean 'soleus_l'"),
        ("muscles: [{name: soleus_l, bias: 2}]", "bias"),
        ("guide: {file: none.csv}", "none.csv cannot be read"),
        ("wieght: 2", "wieght"),
    ],
)
def test_bad_settings_are_told_in_one_line(tmp_path, text, told):
    path = tmp_path / "m.yaml"
    path.write_text(text)
    with pytest.raises(GatewayError, match=told):
        load_costs(path, ("soleus_l", "soleus_r"), np.ones(2), np.arange(3.0))
