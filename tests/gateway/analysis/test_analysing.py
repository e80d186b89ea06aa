"""The whole of it: a person who bows, a machine by its inertia file, and errors on bad input."""

import csv
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

pytest.importorskip("mujoco")
pytest.importorskip("osqp")

from gateway.analysis.analysing import analyse
from gateway.analysis.film import write_film
from gateway.analysis.inertia_file import load_inertia
from gateway.analysis.muscles import find_muscles, muscle_torques
from gateway.analysis.page import write_page
from gateway.analysis.smooth_motion import low_pass, rotation_derivatives
from gateway.analysis.tables import tables, write_tables
from gateway.body.body_file import load_body
from gateway.body.inertia import body_inertia, leg_stature, neutral_positions
from gateway.cli.main import app
from gateway.errors import GatewayError
from gateway.frames import Status
from gateway.recording import SkeletonArrays

GRAVITY = np.array([0.0, 0.0, -9.81])


def bowing(name="human_17", frames=180):
    """Feet still, the trunk bows to 40° and back."""
    body = load_body(name)
    q_wb = np.tile(body.neutral, (frames, body.n_segments, 1))
    bend = np.radians(40) * np.sin(np.linspace(0, np.pi, frames)) ** 2
    upright = Rotation.from_quat(body.neutral, scalar_first=True)
    bowed = (upright * Rotation.from_rotvec(np.outer(-bend, [0, 0, 1]))).as_quat(scalar_first=True)
    for s, segment in enumerate(body.segment_names):
        if not segment.endswith(("pelvis", "thigh", "shank", "foot", "toes")):
            q_wb[:, s] = bowed
    p_w = np.full((frames, body.n_segments, 3), np.nan)
    p_w[:, 0] = [0.0, 0.0, 0.928]
    zero = np.zeros((frames, body.n_segments, 3))
    return SkeletonArrays(
        np.arange(frames) * 20_000_000, np.arange(frames), q_wb, p_w, zero, zero, zero[..., 0],
        np.full(zero.shape[:2], Status.MEASURED, dtype=np.uint8), body,
    )  # fmt: skip


@pytest.fixture(scope="module")
def bow():
    arrays = bowing()
    return analyse(arrays, "bow", body_inertia(arrays.skeleton, 70.0), GRAVITY, 6.0)


def test_bowing_takes_the_trunk_moment_of_statics(bow):
    """At the lowest point the back holds what hangs before it, less what slows it down."""
    joint = [joint.name for joint in bow.skeleton.joints].index("spine")
    middle = len(bow.time_s) // 2
    thorax = bow.skeleton.index("thorax")
    above = [s for s, name in enumerate(bow.skeleton.segment_names)
             if not name.endswith(("pelvis", "thigh", "shank", "foot"))]  # fmt: skip
    turned, placed = bow.dynamics.rotation_wb[middle], bow.dynamics.p_w[middle]
    centres = placed[above] + np.einsum("sij,sj->si", turned[above], bow.inertia.centre[above])
    ahead = centres[:, 0] - placed[thorax, 0]
    still = float(np.sum(bow.inertia.mass[above] * 9.81 * ahead))
    assert still > 50
    assert -bow.torques[middle, joint, 0] == pytest.approx(still, rel=0.15)
    assert bow.torques[0, joint, 0] == pytest.approx(0.0, abs=15)


def test_the_floor_carries_the_bow(bow):
    assert bow.floor.total()[:, 2].mean() == pytest.approx(bow.weight_n, rel=0.02)
    middle = len(bow.time_s) // 2
    pressure = bow.floor.centre_of_pressure()
    assert pressure[middle, :, 0].mean() > pressure[0, :, 0].mean() + 0.02


def test_back_muscles_hold_the_bow(bow):
    found = find_muscles(bow)
    middle = len(bow.time_s) // 2
    back, belly = found.names.index("ercspn_l"), found.names.index("extobl_l")
    assert found.activity[middle, back] > 0.1
    assert found.activity[middle, back] > 3 * found.activity[middle, belly]
    assert found.tension == pytest.approx(found.activity * found.largest_force)
    wanted = np.array([bow.torques[middle, j, k] for j, k in found.torques])
    assert found.arms[middle] @ found.tension[middle] + found.left[middle] == pytest.approx(wanted, abs=1e-6)


def test_tables_hold_every_column_once_and_all_frames(bow, tmp_path):
    written = write_tables(bow, None, tmp_path, "csv")
    assert {path.name for path in written} == {
        "joints.csv",
        "segments.csv",
        "floor.csv",
        "centre_of_mass.csv",
    }
    with (tmp_path / "joints.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(bow.time_s)
    middle = len(rows) // 2
    assert float(rows[middle]["spine_flexion_deg"]) == pytest.approx(
        np.degrees(bow.angles[middle, 0, 0]), abs=1e-6
    )
    assert float(rows[middle]["left_knee_flexion_torque_n_m"]) == pytest.approx(
        tables(bow)["joints"]["left_knee_flexion_torque_n_m"][middle], rel=1e-6
    )


def test_human_23_asks_the_whole_spine_once():
    body = load_body("human_23")
    asked = [body.joints[j].name for j, _ in muscle_torques(body)]
    assert asked.count("spine") == 3
    assert "spine_thorax" not in asked


def test_masses_of_a_person_add_up_and_lie_inside():
    body = load_body("human_23")
    inertia = body_inertia(body, 80.0, "female")
    assert inertia.share == pytest.approx(1.0, abs=2e-3)
    assert leg_stature(body) == pytest.approx(1.75, rel=1e-2)
    com = (inertia.mass @ (neutral_positions(body) + inertia.centre)) / inertia.mass.sum()
    height = com[1] + 0.530 * 1.75  # over the hips, which are at 0.530 of stature
    assert 0.53 < height / 1.75 < 0.58  # 0.55 or so in women and men
    assert (np.linalg.eigvalsh(inertia.inertia) > 0).all()


def test_a_machine_needs_its_inertia_told(tmp_path):
    body = load_body("pendulum_3")
    with pytest.raises(GatewayError, match="--inertia"):
        body_inertia(body, 5.0)
    path = tmp_path / "i.yaml"
    name = body.segment_names[0]
    path.write_text(
        f"segments:\n  {name}: {{mass_kg: 2, centre_m: [0, 0, -0.1], inertia_kg_m2: [0.1, 0.1, 0.01]}}\n"
    )
    assert load_inertia(path, body).mass[0] == 2.0
    path.write_text("segments:\n  linkk: {mass_kg: 2, centre_m: [0, 0, 0], inertia_kg_m2: [1, 1, 1]}\n")
    with pytest.raises(GatewayError, match=r"segments\.linkk: body 'pendulum_3' has no such segment"):
        load_inertia(path, body)


def test_the_low_pass_halves_power_at_its_cut_off_without_lag():
    time_s = np.arange(2000) / 200
    wave = np.sin(2 * np.pi * 6.0 * time_s)
    passed = low_pass(wave, 200.0, 6.0)[500:1500]
    assert np.ptp(passed) / 2 == pytest.approx(np.sqrt(0.5), rel=0.01)
    assert np.argmax(np.correlate(passed, wave[500:1500], "same")) == 500


def test_derivatives_of_an_unnormalised_curve_are_those_of_its_rotation():
    rate, change = 0.7, 0.4
    time_s = np.linspace(0, 1, 5)
    angle = rate * time_s + 0.5 * change * time_s**2
    size, size1, size2 = 1 + 0.3 * time_s, 0.3, 0.0
    half, half1 = angle / 2, (rate + change * time_s) / 2
    zero = np.zeros_like(half)
    q = np.stack([np.cos(half), zero, np.sin(half), zero], axis=1)
    d = np.stack([-np.sin(half), zero, np.cos(half), zero], axis=1)
    q1 = d * half1[:, None]
    q2 = d * (change / 2) - q * half1[:, None] ** 2
    s = size[:, None]
    unit, velocity, acceleration = rotation_derivatives(
        s * q, size1 * q + s * q1, size2 * q + 2 * size1 * q1 + s * q2
    )
    assert unit == pytest.approx(q)
    assert velocity[:, 1] == pytest.approx(rate + change * time_s)
    assert acceleration[:, 1] == pytest.approx(change)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["none.mcap", "--mass", "70"], "none.mcap cannot be read"),
        (["none.mcap"], "none.mcap cannot be read"),
        (["walk.mcap"], "walk.mcap is no recording of mocap-gateway"),
        (["trial.c3d"], "name the person with --subject"),
        (["walk.mcap", "--subject", "me.yaml"], "--subject goes with trials of markers"),
    ],
)
def test_what_cannot_be_analysed_is_told(arguments, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("walk.mcap", "trial.c3d"):
        (tmp_path / name).touch()
    done = CliRunner().invoke(app, ["analyse", *arguments])
    assert done.exit_code == 1
    assert told in str(done.exception)


@pytest.mark.slow(reason="the page's charts of every joint take half a minute to draw")
def test_film_and_page_hold_all_of_it(tmp_path):
    arrays = bowing(frames=40)
    bow = analyse(arrays, "bow", body_inertia(arrays.skeleton, 70.0), GRAVITY, 6.0)
    pulled = find_muscles(bow)
    film, page = tmp_path / "film.webm", tmp_path / "report.html"
    assert write_film(bow, pulled, film) == 24
    write_page(bow, pulled, page, film)
    text = page.read_text()
    assert text.count("<h2>") == 9
    assert "data:video/webm;base64," in text
    assert json.dumps(bow.notes[-1])[1:-1] in text
