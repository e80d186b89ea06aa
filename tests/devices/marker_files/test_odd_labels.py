"""Labels and points as other programs write them."""

from __future__ import annotations

import numpy as np

from devices.marker_files.naming import spellings
from devices.marker_files.trial import label_notes, seen_points

WANTED = ("LASI", "RASI", "LPSI", "RPSI", "LTHI", "LKNE", "C7")


def _all(labels):
    return [spellings(labels, WANTED).get(label) for label in labels]


def test_what_stands_before_and_behind_all_labels_is_no_part_of_them():
    assert _all([f"Anna Maria_Lee_{label}" for label in WANTED]) == list(WANTED)
    assert _all([f"{label}-1" for label in WANTED]) == list(WANTED)
    assert _all([f"model.{label.lower()}_pos" for label in WANTED]) == list(WANTED)


def test_a_subject_with_a_suffix_finds_its_markers_in_a_trial_without():
    with_suffix = [f"{label}_pos" for label in WANTED]
    assert [spellings(list(WANTED), with_suffix).get(label) for label in WANTED] == with_suffix


def test_unnamed_points_do_not_hide_what_all_others_share():
    labels = [*(f"S1_x_{label}" for label in WANTED), "", "*12"]
    assert _all(labels) == [*WANTED, None, None]


def test_points_at_the_origin_or_beyond_a_kilometre_were_not_seen():
    points = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [9999.0, 9999.0, 9999.0], [np.inf, 0.0, 1.0]]])
    assert np.isfinite(seen_points(points)).all(axis=2).tolist() == [[False, True, False, False]]


def test_names_that_several_points_have_are_told():
    assert label_notes(("A", "B", "A", "", "", "*1", "*1"), "f.trc") == (
        "f.trc: several markers are called A: the first of each counts",
    )
