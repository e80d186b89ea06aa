"""Points and units of trials that would lead a fit astray: left out, refused or doubted, and said so."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from devices.marker_files import MarkerTrial, read_markers
from gateway.body.rig import load_rig
from gateway.cli.optical import optical_app
from gateway.errors import GatewayError
from gateway.geometry import quaternion
from gateway.reconstruction.optical.fitted_body import fit_doubts
from gateway.reconstruction.optical.fitting import fit_body
from gateway.reconstruction.optical.ghosts import sides_kept, without_ghosts
from gateway.reconstruction.optical.landmarks import vertical_axis
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.reconstruction.optical.pose_solver import body_model
from gateway.reconstruction.optical.tracking import stands_along
from gateway.reconstruction.optical.worn_markers import fitting_set
from gateway.recording.optical import write_solved_trial
from tests.marked_person import subject_file

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[5] / "shared" / "data"))
needs_data = pytest.mark.skipif(not (DATA / "c3d_pycgm").is_dir(), reason="recordings are not here")


@pytest.fixture(scope="module")
def walk() -> MarkerTrial:
    trial = read_markers(DATA / "c3d_pycgm" / "Movement_trial.c3d")
    return replace(trial, positions=trial.positions[::12])


@needs_data
def test_points_ten_metres_away_are_left_out_and_told(walk):
    labels = fitting_set([walk]).labels
    columns = [walk.labels.index(label) for label in labels if label in walk.labels]
    positions = walk.positions.copy()
    is_ghost = np.random.default_rng(2).random((len(positions), len(columns))) < 0.02
    positions[:, columns] += 10.0 * is_ghost[..., None]
    found = fit_body(fitting_set([walk]), [replace(walk, positions=positions)])
    assert sum(found.trials.ghosts.values()) == is_ghost.sum()
    assert found.rmse < 0.005
    assert any("left out" in doubt for doubt in fit_doubts(found))


@needs_data
def test_a_trial_as_it_is_has_no_ghosts_and_raises_no_doubts(walk):
    marker_set = fitting_set([walk])
    assert without_ghosts(marker_set, walk) == (walk, {})
    assert fit_doubts(fit_body(marker_set, [walk])) == []


@needs_data
@pytest.mark.parametrize("change", ["mirrored", "sides"])
def test_knees_that_bend_backwards_are_doubted(walk, change):
    if change == "mirrored":
        odd = replace(walk, positions=walk.positions * [1.0, -1.0, 1.0])
    else:
        other = {"L": "R", "R": "L"}
        odd = replace(
            walk, labels=tuple(other.get(label[:1], label[:1]) + label[1:] for label in walk.labels)
        )
    found = fit_body(fitting_set([odd]), [odd])
    assert found.backwards == ("left_knee", "right_knee")
    assert "left and right are exchanged" in fit_doubts(found)[0]


@needs_data
def test_exchanged_sides_of_somebody_who_only_stands_are_doubted():
    trial = read_markers(DATA / "c3d_pycgm" / "Static_trial.c3d")
    trial = replace(trial, positions=trial.positions[::60])
    other = {"L": "R", "R": "L"}
    odd = replace(trial, labels=tuple(other.get(label[:1], label[:1]) + label[1:] for label in trial.labels))
    as_it_is = fit_body(fitting_set([trial]), [trial])
    assert as_it_is.backwards == ()
    assert ["nothing moves" in doubt for doubt in fit_doubts(as_it_is)] == [True]
    assert set(fit_body(fitting_set([odd]), [odd]).backwards) >= {"left_hip", "right_hip"}


@needs_data
def test_points_without_names_are_to_be_named_where_they_were_recorded(walk):
    odd = replace(walk, labels=tuple(f"*{m}" for m in range(len(walk.labels))))
    with pytest.raises(GatewayError, match=r"none of its .* points has a name: name the markers"):
        fitting_set([odd])


@needs_data
def test_a_person_of_fifteen_centimetres_is_refused_with_the_unit_that_fits(walk):
    small = replace(walk, positions=0.1 * walk.positions)
    with pytest.raises(
        GatewayError, match=r"0\.1\d* m, in a unit of 0\.001 m: correct the unit.* cm would make it 1\."
    ):
        fit_body(fitting_set([small]), [small])


@needs_data
def test_names_without_points_are_told_as_such(walk):
    empty = replace(walk, positions=np.full_like(walk.positions, np.nan))
    with pytest.raises(GatewayError, match="39 markers by their names, of which 0 are seen"):
        fitting_set([empty])


def test_a_trial_that_shows_nothing_or_is_too_fast_is_not_solved(tmp_path):
    path, _, markers = subject_file(tmp_path, "z")

    suit = load_rig(str(path))
    empty = MarkerTrial("t", markers.labels, 100.0, np.full((5, len(markers.labels), 3), np.nan))
    source = tmp_path / "t.trc"
    source.write_text("")
    with pytest.raises(GatewayError, match="no frame shows 3 of the markers"):
        write_solved_trial(empty, source, suit, str(path), tmp_path / "a.mcap")
    with pytest.raises(GatewayError, match="9999 frames a second, of which 4000"):
        write_solved_trial(replace(empty, rate_hz=9999.0), source, suit, str(path), tmp_path / "b.mcap")


@pytest.mark.parametrize("more", [[], ["--force"]])
def test_an_export_never_replaces_the_trial(tmp_path, more):
    subject, _, _ = subject_file(tmp_path, "z")
    trial = tmp_path / "walk.trc"
    trial.write_text("measured once")
    done = CliRunner().invoke(
        optical_app, ["solve", str(trial), "--subject", str(subject), "--to", "trc", *more]
    )
    assert "name the recording, and with it its exports, otherwise: -o walk_sol" in str(done.exception)
    assert trial.read_text() == "measured once"


def _only(trial: MarkerTrial, segments: tuple[str, ...]) -> MarkerTrial:
    """A trial with the Plug-in-Gait markers of some segments alone."""
    labels = [label for name in segments for label in load_marker_set("plug_in_gait").file.markers[name]]
    kept = [m for m, label in enumerate(trial.labels) if label in labels]
    return replace(trial, labels=tuple(trial.labels[m] for m in kept), positions=trial.positions[:, kept])


@needs_data
def test_an_upper_body_hangs_from_its_thorax(walk):
    sides = [f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm", "hand")]
    girdles = ("left_shoulder_girdle", "right_shoulder_girdle")
    upper = _only(walk, ("thorax", "head", *girdles, *sides))
    found = fit_body(fitting_set([upper]), [upper])
    whole = fit_body(fitting_set([walk]), [walk])
    assert found.skeleton.segment_names[0] == "thorax"
    assert {"pelvis", "left_foot"} <= set(found.trials.left_out)
    assert found.rmse < 0.005
    for name in ("left_forearm", "right_upper_arm", "head"):
        tips = [np.linalg.norm(fit.skeleton.tips[fit.skeleton.index(name)]) for fit in (found, whole)]
        assert tips[0] == pytest.approx(tips[1], abs=0.006), name
    assert "left_elbow_width" in found.measured.lengths
    assert not {"left_knee_width", "right_ankle_width"} & set(found.measured.assumed)


@needs_data
def test_feet_alone_hang_from_nothing(walk):
    feet = _only(walk, ("left_foot", "right_foot", "left_shank", "right_shank"))
    with pytest.raises(GatewayError, match=r"none of its pelvis .*, from which the body hangs.*--set"):
        fit_body(load_marker_set("plug_in_gait"), [feet])


@needs_data
@pytest.mark.parametrize(("turn", "axis"), [([1, -1, -1], "-z"), ([1, 1, 1], "z")])
def test_an_axis_that_points_down_is_found_and_told(walk, turn, axis):
    odd = replace(walk, positions=walk.positions[::3] * np.array(turn, float))
    found = fit_body(fitting_set([odd]), [odd])
    assert found.markers.vertical == axis
    assert any("points down in the files" in doubt for doubt in fit_doubts(found)) == (axis == "-z")
    assert found.backwards == ()


def test_without_feet_and_shoulders_the_axis_is_asked_for():
    trial = MarkerTrial("t", ("LTHI", "LKNE"), 100.0, np.random.default_rng(0).random((5, 2, 3)))
    with pytest.raises(
        GatewayError, match=r"which axis points up is not seen without LHEE .*: tell it with --up"
    ):
        vertical_axis(load_marker_set("plug_in_gait"), trial)


@needs_data
def test_a_static_trial_of_somebody_else_is_doubted(walk):
    still = replace(walk, name="still", positions=1.3 * walk.positions[:4])
    found = fit_body(fitting_set([walk]), [still, walk])
    assert found.other_sizes == {walk.name: pytest.approx(1 / 1.3, abs=0.02)}
    assert any("another person" in doubt for doubt in fit_doubts(found))


@needs_data
def test_a_walk_with_another_axis_up_than_the_static_trial_is_turned_and_told(walk):
    still = replace(walk, name="still", positions=walk.positions[:4])
    odd = replace(walk, positions=walk.positions[..., [1, 2, 0]])  # y up
    alike = fit_body(fitting_set([walk]), [still, walk])
    found = fit_body(fitting_set([walk]), [still, odd])
    assert found.other_axes == {odd.name: "y"}
    assert any("stands along y there, along z" in doubt for doubt in fit_doubts(found))
    np.testing.assert_allclose(found.skeleton.offsets, alike.skeleton.offsets, atol=1e-6)
    markers, neutral = alike.markers, quaternion.to_matrix(alike.skeleton.neutral)
    model = body_model(alike.skeleton, markers)
    along = [stands_along(model, each.columns(markers.labels), neutral) for each in (walk, odd)]
    assert along[0] @ [0.0, 0.0, 1.0] > 0.9
    assert along[1] @ [0.0, 1.0, 0.0] > 0.9


@needs_data
def test_hips_that_the_motion_would_have_elsewhere_are_told(walk):
    found = fit_body(fitting_set([walk]), [walk])
    assert not found.centres.is_functional
    assert set(found.centres.strained) <= {"left_thigh", "right_thigh"}
    assert np.isfinite(found.centres.rmse_free) == bool(found.centres.strained)


def test_a_second_trial_in_one_file_is_left_out_and_told(tmp_path):
    trial = MarkerTrial("t", ("A", "B"), 50.0, np.random.default_rng(1).random((4, 2, 3)))
    path = tmp_path / "twice.trc"
    lines = [
        "PathFileType\t4\t(X/Y/Z)\ttwice.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        "50\t50\t4\t2\tm",
        "Frame#\tTime\tA\t\t\tB",
        "\t\tX1\tY1\tZ1\tX2\tY2\tZ2",
        *(
            "\t".join([str(f + 1), f"{f / 50:g}", *map(str, places.ravel())])
            for f, places in enumerate(trial.positions)
        ),
    ]
    path.write_text("\n".join([*lines, *lines]) + "\n")
    read = read_markers(path)
    assert read.n_frames == 4
    assert "from line 10 on another trial: left out" in read.notes[0]


LEG = ("THI", "KNE", "TIB", "ANK", "HEE", "TOE")


def with_sides_exchanged(trial: MarkerTrial, names: tuple[str, ...], frames: slice) -> MarkerTrial:
    places = trial.positions.copy()
    for name in names:
        left, right = trial.labels.index(f"L{name}"), trial.labels.index(f"R{name}")
        places[frames, left] = trial.positions[frames, right]
        places[frames, right] = trial.positions[frames, left]
    return replace(trial, positions=places)


@needs_data
@pytest.mark.parametrize("frames", [slice(20, 30), slice(None, 20), slice(20, None), slice(5, 60)])
@pytest.mark.parametrize("names", [LEG, ("KNE", "ANK"), ("ELB", "WRA", "WRB")])
def test_sides_that_are_exchanged_for_a_while_are_put_right(frames, names):
    trial = read_markers(DATA / "c3d_pycgm" / "Movement_trial.c3d")
    trial = replace(trial, positions=trial.positions[::5], rate_hz=trial.rate_hz / 5)
    marker_set = fitting_set([trial])
    kept, found = sides_kept(marker_set, with_sides_exchanged(trial, names, frames))
    np.testing.assert_array_equal(kept.positions, trial.positions)
    assert set(found) == {f"L{name}" for name in names}
    assert set(found.values()) == {len(range(*frames.indices(trial.n_frames)))}


@needs_data
@pytest.mark.parametrize("thinned", [1, 3, 8])
def test_sides_that_are_right_stay(thinned):
    for name in ("c3d_pycgm/Movement_trial.c3d", "c3d_ktk/kinematics_tennis_serve.c3d"):
        trial = read_markers(DATA / name)
        trial = replace(trial, positions=trial.positions[::thinned], rate_hz=trial.rate_hz / thinned)
        assert sides_kept(fitting_set([trial]), trial) == (trial, {})


@needs_data
def test_exchanged_sides_move_no_joint_and_are_told(walk):
    trial = replace(walk, rate_hz=walk.rate_hz / 12)
    marker_set = fitting_set([trial])
    expected = fit_body(marker_set, [trial])
    found = fit_body(marker_set, [with_sides_exchanged(trial, LEG, slice(9, 15))])
    np.testing.assert_allclose(found.skeleton.offsets, expected.skeleton.offsets, atol=1e-9)
    assert any("left and right were exchanged in part of a trial" in doubt for doubt in fit_doubts(found))


@needs_data
def test_a_foot_that_is_turned_about_is_doubted(walk):
    names = {"LHEE": "LTOE", "LTOE": "LHEE"}
    odd = replace(walk, labels=tuple(names.get(label, label) for label in walk.labels))
    found = fit_body(fitting_set([odd]), [odd])
    assert found.turned == ("left_ankle",)
    assert "left_ankle is turned about: do two of the markers beyond it (LHEE LTOE)" in fit_doubts(found)[0]


@needs_data
def test_names_that_the_set_lacks_are_told_where_a_limb_is_left_out(walk):
    odd = replace(walk, labels=tuple(f"Hand {label}" if "FIN" in label else label for label in walk.labels))
    found = fit_body(fitting_set([odd]), [odd])
    assert {"left_hand", "right_hand"} == {*found.trials.left_out}
    assert any("the set has no " in doubt and "rename" in doubt for doubt in fit_doubts(found))
