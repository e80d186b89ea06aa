"""Labels and points as other programs write them."""

from __future__ import annotations

import re

import numpy as np
import pytest

from devices.marker_files.naming import spellings
from devices.marker_files.trial import joined_pieces, seen_points
from devices.vendor_formats.sheets import FormatError

WANTED = ("LASI", "RASI", "LPSI", "RPSI", "LTHI", "LKNE", "C7")


def _all(labels):
    return [spellings(labels, WANTED).get(label) for label in labels]


def test_what_stands_before_and_behind_all_labels_is_no_part_of_them():
    assert _all([f"Anna Maria_Lee_{label}" for label in WANTED]) == list(WANTED)
    assert _all([f"{label}-1" for label in WANTED]) == list(WANTED)
    assert _all([f"model.{label.lower()}_pos" for label in WANTED]) == list(WANTED)


def test_letters_before_all_labels_and_sides_written_before_are_no_part_of_them():
    assert _all([f"Ana{label}" for label in WANTED]) == list(WANTED)
    assert _all([f"S01{label}" for label in WANTED]) == list(WANTED)
    sides = {"L": "Left", "R": "Right"}
    assert _all([sides.get(label[0], label[0]) + label[1:] for label in WANTED]) == list(WANTED)


def test_a_side_that_all_labels_begin_with_stays():
    left = ("LASI", "LPSI", "LTHI", "LKNE", "LTIB")
    assert spellings(left, (*left, *(f"R{label[1:]}" for label in left))) == {label: label for label in left}


def test_a_subject_with_a_suffix_finds_its_markers_in_a_trial_without():
    with_suffix = [f"{label}_pos" for label in WANTED]
    assert [spellings(list(WANTED), with_suffix).get(label) for label in WANTED] == with_suffix


def test_unnamed_points_do_not_hide_what_all_others_share():
    labels = [*(f"S1_x_{label}" for label in WANTED), "", "*12"]
    assert _all(labels) == [*WANTED, None, None]


def test_points_at_the_origin_or_beyond_a_kilometre_were_not_seen():
    points = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [9999.0, 9999.0, 9999.0], [np.inf, 0.0, 1.0]]])
    assert np.isfinite(seen_points(points)).all(axis=2).tolist() == [[False, True, False, False]]


def test_a_side_may_stand_behind_a_name_or_be_written_out():
    behind = [f"{label[1:]}_{label[0]}" if label[0] in "LR" else label for label in WANTED]
    written = [label.replace("L", "Left ", 1) if label[0] == "L" else label for label in WANTED]
    assert _all(behind) == _all(written) == list(WANTED)


def test_people_may_stand_behind_the_names_of_their_markers():
    labels = [f"{label}_{person}" for person in (1, 2) for label in WANTED]
    with pytest.raises(FormatError, match="markers of 1 and 2: tell whose are meant with --person 1"):
        spellings(labels, WANTED)
    assert spellings(labels, WANTED, person="2") == {f"{label}_2": label for label in WANTED}
    assert spellings(labels, ("R.ASIS", "X1"), {"RASI": "R.ASIS"}, person="2") == {"RASI_2": "R.ASIS"}
    own = [f"{label}_2" for label in WANTED]
    assert spellings(labels, own) == {label: label for label in own}


def test_clusters_that_are_numbered_are_no_people():
    wanted = (*WANTED, "LTHI1", "LTHI2", "RTHI1", "RTHI2", "LTIB1", "LTIB2", "LTHI", "RTHI", "LTIB")
    labels = [re.sub(r"([A-Z])([12])$", r"\1_\2", label) for label in wanted]
    assert list(map(spellings(labels, wanted).get, labels)) == list(wanted)


def test_names_that_several_points_have_are_told():
    labels, points = ("A", "B", "A", "", "", "*1", "*1"), np.ones((2, 7, 3))
    assert joined_pieces(labels, points, "f.trc") == (
        labels,
        points,
        ("f.trc: several markers are called A: the first of each counts",),
    )


@pytest.mark.parametrize("again", ["LASI", "LASI_1", "LASI - 2", "LASI (3)"])
def test_a_trajectory_in_pieces_is_one_marker(again):
    points = np.full((6, 3, 3), np.nan)
    points[:3, 0], points[4:, 2], points[:, 1] = 1.0, 2.0, 3.0
    labels, joined, (note,) = joined_pieces(("LASI", "RASI", again), points, "f.trc")
    assert labels == ("LASI", "RASI")
    assert joined[:, 0, 0].tolist()[:3] == [1.0] * 3
    assert joined[4:, 0, 0].tolist() == [2.0, 2.0]
    assert "LASI in pieces" in note


def test_markers_that_are_seen_together_are_no_pieces():
    labels = ("LTHI", "LTHI_1", "LTH1", "A_1", "A_2")
    assert joined_pieces(labels, np.ones((2, 5, 3)), "f.trc")[0] == labels
