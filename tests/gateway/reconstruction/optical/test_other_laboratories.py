"""One trial as other laboratories would have recorded it: names, people, axes, fewer markers, other sets."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.marker_files import MarkerTrial, read_markers
from devices.marker_files.naming import plain, spellings, spelt, without_prefixes
from devices.vendor_formats.sheets import FormatError
from gateway.body.body_file import WorldSettings, load_body, worn_without_modules
from gateway.body.skeleton import BodyMarkers
from gateway.errors import GatewayError
from gateway.reconstruction.optical.fitted_body import uneven_sides
from gateway.reconstruction.optical.fitting import FitOptions, fit_body
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.reconstruction.optical.worn_markers import fitting_set, worn_part
from gateway.recording import open_recording
from gateway.recording.optical import write_solved_trial

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[5] / "shared" / "data"))
needs_data = pytest.mark.skipif(not (DATA / "c3d_pycgm").is_dir(), reason="recordings are not here")
LEGS = [
    "LASI", "RASI", "LPSI", "RPSI", "LTHI", "LKNE", "LTIB", "LANK", "LHEE", "LTOE", "RTHI", "RKNE", "RTIB",
    "RANK", "RHEE", "RTOE",
]  # fmt: skip
CAST = {
    "ASIS": "IAS", "Thigh.Upper": "TH1", "Thigh.Front": "TH2", "Thigh.Rear": "TH3", "Knee.Lat": "FLE",
    "Knee.Med": "FME", "Shank.Upper": "SK1", "Shank.Front": "SK2", "Shank.Rear": "SK3", "Ankle.Lat": "FAL",
    "Ankle.Med": "TAM", "Heel": "FCC", "Toe.Med": "FM1", "Toe.Tip": "FM2", "Toe.Lat": "FM5",
}  # fmt: skip
HAYES = {
    "ASIS": "ASIS", "Thigh.Front": "Thigh", "Knee.Lat": "Knee", "Knee.Med": "Knee.Medial", "Heel": "Heel",
    "Shank.Front": "Shank", "Ankle.Lat": "Ankle", "Ankle.Med": "Ankle.Medial", "Toe.Tip": "Toe",
}  # fmt: skip


def called(trials: list[MarkerTrial], name: Callable[[str], str]) -> list[MarkerTrial]:
    return [replace(trial, labels=tuple(map(name, trial.labels))) for trial in trials]


@pytest.fixture(scope="module")
def gait() -> list[MarkerTrial]:
    """Pelvis and legs of a static trial and a walk, every twelfth frame."""
    trials = [read_markers(DATA / "c3d_pycgm" / f"{name}_trial.c3d") for name in ("Static", "Movement")]
    thinned = [replace(trial, positions=trial.positions[::12]) for trial in trials]
    return called(thinned, lambda label: label if label in LEGS else "")


@pytest.fixture(scope="module")
def opensim() -> list[MarkerTrial]:
    names = ("subject01_static", "marker_trajectories")
    trials = [read_markers(DATA / "trc_opensim" / f"{name}.trc") for name in names]
    return [replace(trial, positions=trial.positions[::9]) for trial in trials]


def lengths(trials: list[MarkerTrial], options: FitOptions | None = None) -> dict[str, float]:
    """Of thighs and shanks, m, by the set that fits."""
    options = options or FitOptions()
    found = fit_body(fitting_set(trials, options.person), trials, options).skeleton
    return {
        name: float(np.linalg.norm(tip))
        for name, tip in zip(found.segment_names, found.tips, strict=True)
        if "thigh" in name or "shank" in name
    }


def beside_another(trials: list[MarkerTrial]) -> list[MarkerTrial]:
    """Bob, and Eve two metres beside him, who moves alike."""
    both = called(trials, lambda label: f"Bob:{label}" if label else "")
    eve = called(trials, lambda label: f"Eve:{label}" if label else "")
    return [
        replace(one, labels=one.labels + two.labels, positions=np.hstack([one.positions, 2 + two.positions]))
        for one, two in zip(both, eve, strict=True)
    ]


def with_one_sacral_marker(trials: list[MarkerTrial]) -> list[MarkerTrial]:
    middles = [trial.columns(("LPSI", "RPSI")).mean(axis=1, keepdims=True) for trial in trials]
    rest = called(trials, lambda label: "" if label in ("LPSI", "RPSI") else label)
    return [
        replace(trial, labels=(*trial.labels, "Sacrum"), positions=np.hstack([trial.positions, middle]))
        for trial, middle in zip(rest, middles, strict=True)
    ]


VARIANTS: dict[str, Callable[[list[MarkerTrial]], list[MarkerTrial]]] = {
    "small letters": lambda trials: called(trials, str.lower),
    "a prefix with underscore": lambda trials: called(trials, lambda label: f"Bob_{label}" if label else ""),
    "y up": lambda trials: [replace(t, positions=t.positions[:, :, [1, 2, 0]]) for t in trials],
    "one sacral marker": with_one_sacral_marker,
}


@needs_data
def test_spelling_axes_and_people_change_nothing(gait: list[MarkerTrial]) -> None:
    expected = lengths(gait)
    assert len(expected) == 4
    for name, change in VARIANTS.items():
        assert lengths(change(gait)) == pytest.approx(expected, abs=0.003), name
    assert lengths(beside_another(gait), FitOptions(person="Eve")) == pytest.approx(expected, abs=1e-4)


@needs_data
def test_the_fit_tells_what_it_leaves_out_and_keeps_the_files_names(gait: list[MarkerTrial]) -> None:
    trials = called(gait, lambda label: f"S1_{label}" if label else "")
    found = fit_body(load_marker_set("plug_in_gait"), trials)
    assert len(found.trials.left_out) == 10
    assert {"thorax", "head", "left_hand"} <= set(found.trials.left_out)
    assert set(found.markers.labels) == {f"S1_{label}" for label in LEGS}


@needs_data
def test_a_limb_with_too_few_markers_is_left_out_and_named(gait: list[MarkerTrial]) -> None:
    trials = called(gait, lambda label: "" if label == "RHEE" else label)
    found = fit_body(load_marker_set("plug_in_gait"), trials)
    assert found.too_few == {"right_foot": ("RHEE",)}
    assert "right_foot" not in found.skeleton.segment_names
    assert {"right_shank", "left_foot"} <= set(found.skeleton.segment_names)
    assert "RTOE" not in found.markers.labels
    arm = {"LSHO", "LUPA", "LFRM", "LWRA", "LWRB", "LFIN"}
    both = [read_markers(DATA / "c3d_pycgm" / f"{name}_trial.c3d") for name in ("Static", "Movement")]
    thinned = [replace(trial, positions=trial.positions[:240:12]) for trial in both]
    found = fit_body(load_marker_set("plug_in_gait"), called(thinned, lambda m: "" if m in arm else m))
    assert set(found.too_few) >= {"left_shoulder_girdle", "left_upper_arm"}
    assert "left_upper_arm" not in found.skeleton.segment_names
    assert "right_hand" in found.skeleton.segment_names
    without_a_knee = called(gait, lambda label: "" if label == "LKNE" else label)
    found = fit_body(load_marker_set("plug_in_gait"), without_a_knee)
    assert set(found.too_few) == {"left_thigh", "left_shank", "left_foot"}
    assert "LKNE" in found.too_few["left_thigh"]


@needs_data
@pytest.mark.parametrize(
    ("person", "message"),
    [(None, "markers of Bob and Eve: tell whose are meant with --person Bob"), ("Mia", "there are Bob, Eve")],
)
def test_several_people_are_asked_about(gait, person: str | None, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        fitting_set(beside_another(gait), person)


def test_a_subject_finds_its_own_persons_markers_among_two() -> None:
    wanted = [f"Bob:{label}" for label in LEGS]
    labels = [f"Eve:{label}" for label in LEGS] + wanted
    assert spellings(labels, wanted) == {label: label for label in wanted}
    with_underscores = [label.replace(":", "_") for label in labels]
    found = spellings(with_underscores, wanted)
    assert found == {f"Bob_{label}": f"Bob:{label}" for label in LEGS}
    assert spellings(labels, wanted, person="Eve") == {f"Eve:{label}": f"Bob:{label}" for label in LEGS}
    with pytest.raises(FormatError, match="markers of Eve and Bob"):
        spellings(labels, [f"Ann:{label}" for label in LEGS])


def test_a_persons_name_may_hold_blanks_before_its_colon() -> None:
    labels = [f"{person}:{label}" for person in ("Mr A", "Ms B") for label in LEGS]
    with pytest.raises(FormatError, match="--person 'Mr A'"):
        spellings(labels, LEGS)
    assert spellings(labels, LEGS, person="Ms B") == {f"Ms B:{label}": label for label in LEGS}


def test_another_persons_markers_do_not_stand_in_for_the_chosen_ones() -> None:
    labels = ("Bob:LASI", "Bob:RASI", "Eve:LASI", "Eve:RASI")
    places = np.arange(12.0).reshape(1, 4, 3)
    trial = MarkerTrial("two", labels, 100.0, places)
    found = spelt(trial, ("Bob:LASI", "Bob:RASI"), person="Eve")
    np.testing.assert_array_equal(found.columns(("Bob:LASI", "Bob:RASI")), places[:, 2:])


@needs_data
def test_whose_markers_a_solved_trial_has_is_told_or_follows_from_the_subject(gait, tmp_path: Path) -> None:
    both = beside_another(gait)
    (tmp_path / "t.c3d").touch()
    for fitted, person in (("Bob", None), ("Eve", None), ("Bob", "Eve")):
        fit = fit_body(load_marker_set("plug_in_gait"), both, FitOptions(person=fitted))
        suit = worn_without_modules(fit.skeleton, fit.markers, WorldSettings())
        target = tmp_path / f"{fitted}_{person}.mcap"
        done = write_solved_trial(both[1], tmp_path / "t.c3d", suit, "me.yaml", target, person=person)
        root = open_recording(target).skeleton_arrays().p_w[0, 0]
        pelvis = both[1].columns(tuple(f"{person or fitted}:{label}" for label in LEGS[:4]))[0].mean(axis=0)
        assert np.linalg.norm(root - pelvis) < 0.15
        assert done.rmse < 0.01


@needs_data
@pytest.mark.parametrize(("set_name", "names"), [("ior_cast", CAST), ("helen_hayes", HAYES)])
def test_other_sets_on_the_same_walk_find_the_same_legs(
    opensim, set_name: str, names: dict[str, str]
) -> None:
    """The walk has no medial markers: those of the static trial hold for both."""
    separator = "_" if names is CAST else "."
    trials = called(
        opensim,
        lambda label: (
            f"{label[0]}{separator}{names[label[2:]]}"
            if label[2:] in names
            else label
            if set_name == "helen_hayes" and label == "V.Sacral"
            else ""
        ),
    )
    if names is CAST:
        trials = [
            replace(
                trial,
                labels=(*trial.labels, "LPSI", "RPSI"),
                positions=np.hstack([trial.positions, iliac_spines_behind(own)]),
            )
            for trial, own in zip(trials, opensim, strict=True)
        ]
    assert fitting_set(trials).file.name == set_name
    expected = {
        f"{side}_shank": float(np.linalg.norm(np.diff(joints(opensim[0], side[0].upper()), axis=0)))
        for side in ("left", "right")
    }
    found = lengths(trials)
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=0.004)


@needs_data
def test_legs_without_any_medial_marker_are_alike_on_both_sides() -> None:
    """A straight leg shows no axis of its knee: what was taken for it turned feet into 186 and 260 mm."""
    trial = read_markers(DATA / "trc_opensim" / "markers_walk.trc")
    trial = replace(trial, positions=trial.positions[::9])
    found = fit_body(fitting_set([trial]), [trial]).skeleton
    tips = dict(zip(found.segment_names, 1e3 * np.linalg.norm(found.tips, axis=1), strict=True))
    assert 195 < tips["left_foot"] < tips["right_foot"] < 235
    assert uneven_sides(tips) == []


def test_sides_that_differ_are_told() -> None:
    lengths_mm = {"pelvis": 119.0, "left_foot": 186.0, "right_foot": 260.0, "left_hand": 90.0}
    assert uneven_sides(lengths_mm) == [("left_foot", "right_foot")]
    assert uneven_sides(lengths_mm | {"left_foot": 228.0, "right_foot": 205.0}) == []


def iliac_spines_behind(trial: MarkerTrial) -> np.ndarray:
    """(F, 2, 3) m: 4 cm to the left and right of the sacral marker."""
    across = np.diff(trial.columns(("L.ASIS", "R.ASIS")), axis=1)
    across *= 0.04 / np.linalg.norm(across, axis=2, keepdims=True)
    sacrum = trial.columns(("V.Sacral",))
    return np.hstack([sacrum - across, sacrum + across])


def joints(trial: MarkerTrial, side: str) -> np.ndarray:
    """(2, 3) m: the middles of knee and ankle, standing."""
    return np.array(
        [
            np.nanmean(trial.columns((f"{side}.{joint}.Lat", f"{side}.{joint}.Med")), axis=(0, 1))
            for joint in ("Knee", "Ankle")
        ]
    )


@needs_data
def test_a_set_that_is_not_known_is_refused_with_what_there_is(gait: list[MarkerTrial]) -> None:
    strange = called(gait, lambda label: f"M{LEGS.index(label)}" if label in LEGS else "*3")
    with pytest.raises(GatewayError, match=r"no shipped set \(helen_hayes, .*it has M\d+, .*--set"):
        fitting_set(strange)
    lacking = called(gait, lambda label: "" if label in ("LPSI", "RPSI") else label)
    with pytest.raises(GatewayError, match=r"pelvis needs LASI, .*the trials lack LPSI, RPSI: "):
        fit_body(load_marker_set("plug_in_gait"), lacking)


def test_every_shipped_set_tells_its_markers_apart() -> None:
    for name in ("plug_in_gait", "opensim_41", "helen_hayes", "ior_cast"):
        marker_set = load_marker_set(name)
        meant = {**marker_set.other_names, **{label: label for label in marker_set.labels}}
        for spelling, label in meant.items():
            trial = MarkerTrial("t", (spelling.lower(),), 100.0, np.zeros((1, 1, 3)))
            found = spelt(trial, marker_set.labels, marker_set.other_names)
            assert found.labels == (label,), (name, spelling)


def test_a_limb_without_markers_goes_with_all_beyond_it() -> None:
    whole = load_marker_set("plug_in_gait")
    part = worn_part(whole, [*LEGS, "C7", "T10", "CLAV", "STRN", "LSHO"])
    assert part.body.segment_names[:3] == ("pelvis", "thorax", "left_shoulder_girdle")
    assert "left_upper_arm" not in part.body.segment_names
    assert worn_part(whole, whole.labels).body.segment_names == whole.body.segment_names


def test_prefixes_stay_where_two_people_would_have_the_same_names() -> None:
    assert without_prefixes(["Bob:LASI", "Bob:RASI", "*4", ""]) == ("LASI", "RASI", "*4", "")
    assert without_prefixes(["Bob:LASI", "Eve:LASI", "", ""]) == ("Bob:LASI", "Eve:LASI", "", "")


def test_a_trial_with_two_of_the_subjects_markers_is_refused(tmp_path: Path) -> None:
    """As the toes of one set are called like those of another: nothing came of it, and nothing was said."""
    body = load_body("lower_body_7")
    labels = ("LHEE", "LTOE", "RHEE", "RTOE")
    markers = BodyMarkers(labels, np.array([3, 3, 6, 6]), np.zeros((4, 3)), np.full(4, 0.004), "z")
    trial = MarkerTrial("t", ("L.Toe", "R.Toe", "HEAD"), 100.0, np.zeros((5, 3, 3)))
    suit, target = worn_without_modules(body, markers, WorldSettings()), tmp_path / "t.mcap"
    with pytest.raises(GatewayError, match=r"t\.c3d has only LTOE, RTOE of the markers of me\.yaml .*HEAD"):
        write_solved_trial(trial, tmp_path / "t.c3d", suit, "me.yaml", target)
    assert not target.exists()


LANDMARKS = {
    "ASIS": "@_IAS", "Sacral": "SACR", "Sternum": "SJN", "Temple": "@_HEAD", "Acromium": "@_SAE",
    "Bicep": "@_HUM", "Elbow": "@_HLE", "Wrist.Med": "@_USP", "Wrist.Lat": "@_RSP",
    "Thigh.Upper": "@_TH1", "Knee.Lat": "@_FLE",
    "Knee.Med": "@_FME", "Shank.Upper": "@_SK1", "Ankle.Lat": "@_FAL", "Ankle.Med": "@_TAM", "Heel": "@_FCC",
    "Toe.Tip": "@_FM2", "Toe.Lat": "@_FM5",
}  # fmt: skip
QUALISYS = {
    "ASIS": "Q_Waist@Front", "Sacral": "Q_WaistBack", "Sternum": "Q_Chest", "Temple": "Q_Head@",
    "Acromium": "Q_@ShoulderTop", "Bicep": "Q_@Arm", "Elbow": "Q_@ElbowOut", "Wrist.Med": "Q_@WristOut",
    "Wrist.Lat": "Q_@WristIn", "Thigh.Front": "Q_@ThighFrontLow", "Knee.Lat": "Q_@KneeOut",
    "Knee.Med": "Q_@KneeIn", "Shank.Upper": "Q_@ShinFrontHigh", "Ankle.Lat": "Q_@AnkleOut",
    "Heel": "Q_@HeelBack", "Toe.Tip": "Q_@Forefoot2", "Toe.Lat": "Q_@Forefoot5",
}  # fmt: skip


@needs_data
@pytest.mark.parametrize("names", [LANDMARKS, QUALISYS], ids=["landmarks", "qualisys"])
def test_whole_bodies_by_landmarks_have_the_arms_and_legs_of_the_same_markers_by_other_names(opensim, names):
    renamed = called(
        opensim, lambda label: names.get(label.partition(".")[2] or label, "").replace("@", label[0])
    )
    found = fit_body(fitting_set(renamed), renamed)
    same = fit_body(load_marker_set("opensim_41"), opensim)
    assert found.marker_set == "ior_cast"
    assert found.trials.left_out == ("left_hand", "right_hand")
    assert not found.too_few
    assert found.rmse < 0.004
    for name in ("upper_arm", "forearm", "thigh", "foot"):
        for side in ("left", "right"):
            tips = [
                np.linalg.norm(fit.skeleton.tips[fit.skeleton.index(f"{side}_{name}")])
                for fit in (found, same)
            ]
            assert abs(tips[0] - tips[1]) < 0.006, (side, name)


@needs_data
def test_medial_markers_of_cgm2_say_where_knees_are(opensim):
    names = {
        "ASIS": "@ASI", "Sacral": "SACR", "Thigh.Front": "@THI", "Thigh.Upper": "@THAP",
        "Thigh.Rear": "@THAD", "Knee.Lat": "@KNE", "Knee.Med": "@KNM", "Shank.Front": "@TIB",
        "Shank.Upper": "@TIAP", "Ankle.Lat": "@ANK",
        "Ankle.Med": "@MED", "Heel": "@HEE", "Toe.Tip": "@TOE", "Toe.Med": "@FMH", "Toe.Lat": "@VMH",
    }  # fmt: skip
    renamed = called(
        opensim, lambda label: names.get(label.partition(".")[2] or label, "").replace("@", label[0])
    )
    found = fit_body(fitting_set(renamed), renamed)
    same = fit_body(load_marker_set("opensim_41"), opensim)
    assert found.marker_set == "plug_in_gait"
    for name in ("left_thigh", "right_thigh"):
        lengths = [np.linalg.norm(fit.skeleton.tips[fit.skeleton.index(name)]) for fit in (found, same)]
        assert abs(lengths[0] - lengths[1]) < 0.008


@pytest.mark.parametrize("name", ["helen_hayes", "ior_cast", "opensim_41", "plug_in_gait"])
def test_every_further_name_means_one_marker(name):
    marker_set = load_marker_set(name)
    meant: dict[str, set[str]] = {}
    for spelling, label in [*((own, own) for own in marker_set.labels), *marker_set.other_names.items()]:
        meant.setdefault(plain(spelling), set()).add(label)
    assert {spelling: labels for spelling, labels in meant.items() if len(labels) > 1} == {}
