"""A fitted body: its figures, and what speaks against the trials that it was fitted to."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray
from gateway.reconstruction.optical.landmarks import Measured
from gateway.reconstruction.optical.worn_markers import NamedTrials

MOST_REST_MM = 20.0
"""RMS: skin leaves 3 to 10."""
MOST_UNEVEN = 1.15
"""Longer over shorter, of the two segments of one name: beyond it a marker may sit elsewhere."""
_NAMED = 12
"""Of a file's markers in a note."""


class JointCentres(NamedTuple):
    """What decided where the joints are."""

    is_functional: bool
    """Whether joints are where the motion has them, whatever rules say: asked for, or since markers are met
    far better without rules."""
    strained: tuple[str, ...] = ()
    """Segments whose joints come from a regression, and went as far from it as it lets them."""
    rmse_free: float = np.nan
    """m: ``Fit.rmse``, had the motion decided alone; NaN where no joint strains."""


@dataclass(frozen=True)
class Fit:
    """A fitted body, and how it came about. S segments."""

    skeleton: Skeleton
    markers: BodyMarkers
    trials: NamedTrials
    """What it was fitted to, and what of that was left out or put right."""
    measured: Measured
    centres: JointCentres
    frames: int
    rmse: float
    """m, of the frames it was fitted to."""
    moved: FloatArray
    """(S,) m: how far the motion moved every joint from where rules had it."""
    too_few: Mapping[str, tuple[str, ...]]
    """Segments that carry too few for their axes, and those beyond them: with the markers that lack."""
    other_sizes: Mapping[str, float]
    """Trials whose markers are farther apart or nearer than those of the first, and how many times."""
    other_axes: Mapping[str, str]
    """Trials in which another axis points up than in the first, and which: they were turned."""
    backwards: tuple[str, ...]
    """Joints that bend only to the side to which they cannot, or whose segments are turned about."""
    turned: tuple[str, ...]
    """Joints whose segment is turned about, where nothing bends backwards on both sides."""
    is_still: bool
    """Whether nothing moves in any of the trials."""

    @property
    def marker_set(self) -> str:
        """Name of the set whose markers the person wears."""
        return self.trials.marker_set.file.name

    @property
    def lengths_mm(self) -> dict[str, float]:
        """Length of each segment, mm, by its name."""
        return {
            name: round(1e3 * float(np.linalg.norm(tip)), 1)
            for name, tip in zip(self.skeleton.segment_names, self.skeleton.tips, strict=True)
        }

    @property
    def moved_mm(self) -> dict[str, float]:
        """How far the motion moved the joint of each segment, mm, by the segment's name."""
        names = self.skeleton.segment_names
        return {name: round(1e3 * float(d), 1) for name, d in zip(names, self.moved, strict=True)}

    def worn_on(self, name: str) -> str:
        """Return labels of the markers on a segment."""
        segment = self.skeleton.segment_names.index(name)
        on = zip(self.markers.labels, self.markers.segments, strict=True)
        return " ".join(label for label, where in on if where == segment)

    @property
    def turned_about(self) -> list[tuple[str, str]]:
        """Joints whose segments are turned about, each with the markers on that segment."""
        names = self.skeleton.segment_names
        distal = {joint.name: names[joint.distal] for joint in self.skeleton.joints}
        return [(joint, self.worn_on(distal[joint])) for joint in self.turned]

    def figures(self) -> dict[str, object]:
        """Return what was found, as JSON takes it."""
        return {
            "marker_set": self.marker_set,
            "frames": self.frames,
            "rmse_mm": round(1e3 * self.rmse, 2),
            "markers": len(self.markers.labels),
            "assumed": list(self.measured.assumed),
            "up": self.markers.vertical,
            "angles_deg": {name: round(math.degrees(a), 2) for name, a in self.measured.angles.items() if a},
            "left_out": list(self.trials.left_out),
            "functional": self.centres.is_functional,
            "strained": list(self.centres.strained),
            "ghosts": dict(self.trials.ghosts),
            "exchanged": dict(self.trials.exchanged),
            "backwards": list(self.backwards),
            "turned": list(self.turned),
            "too_few": {name: list(labels) for name, labels in self.too_few.items()},
            "lengths_mm": self.lengths_mm,
            "uneven": uneven_sides(self.lengths_mm),
            "moved_mm": self.moved_mm,
            "sigma_mm": {
                label: round(1e3 * float(s), 1)
                for label, s in zip(self.markers.labels, self.markers.sigmas, strict=True)
            },
        }


def by_lacking(too_few: Mapping[str, tuple[str, ...]]) -> dict[str, list[str]]:
    """Return the segments that were left out, by the markers that lack."""
    found: dict[str, list[str]] = {}
    for name, lacking in too_few.items():
        found.setdefault(", ".join(lacking) or "a frame with all of theirs", []).append(name)
    return found


def uneven_sides(lengths_mm: Mapping[str, float]) -> list[tuple[str, str]]:
    """Return segments of the left and of the right, the longer more than ``MOST_UNEVEN`` times the
    shorter."""
    pairs = [(name, name.replace("left_", "right_", 1)) for name in lengths_mm if name.startswith("left_")]
    return [
        (left, right)
        for left, right in pairs
        if right in lengths_mm
        and max(lengths_mm[left], lengths_mm[right]) > MOST_UNEVEN * min(lengths_mm[left], lengths_mm[right])
    ]


def fit_doubts(found: Fit) -> list[str]:
    """Return what speaks against the files, a sentence each."""
    return [*_doubts_on_markers(found), *_doubts_on_trials(found)]


def _doubts_on_markers(found: Fit) -> list[str]:
    """Return whether points seem to have others' names, or the files another axis."""
    trials, doubts = found.trials, []
    if trials.ghosts:
        by_marker = ", ".join(f"{label} {count}" for label, count in trials.ghosts.items())
        doubts.append(f"points far from the markers beside them were left out ({by_marker})")
    if trials.exchanged:
        by_marker = ", ".join(f"{label} {count}" for label, count in trials.exchanged.items())
        doubts.append(
            f"left and right were exchanged in part of a trial, and put right (frames: {by_marker})"
        )
    if found.markers.vertical.startswith("-"):
        axis = found.markers.vertical[1:]
        doubts.append(f"{axis} points down in the files; a person on the hands is told with --up {axis}")
    if found.backwards:
        doubts.append(
            f"{' and '.join(found.backwards)} bend backwards: left and right are exchanged in the markers' "
            "names, or an axis of the file points the other way (a mirrored world)"
        )
    doubts += [
        f"{name} is turned about: do two of the markers beyond it ({beyond}) have each other's name?"
        for name, beyond in found.turned_about
    ]
    if trials.strangers and (trials.left_out or found.too_few):
        names = ", ".join(trials.strangers[:_NAMED]) + (", …" if len(trials.strangers) > _NAMED else "")
        doubts.append(
            f"the set has no {names}: rename those that sit on a segment that is left out as the set "
            "calls them, or describe them in a file and name it with --set"
        )
    return doubts


def _doubts_on_trials(found: Fit) -> list[str]:
    """Return whether trials are of no use, or unlike each other, or unlike the body that was found."""
    doubts = []
    if found.is_still:
        doubts.append(
            "nothing moves in the trials: joints are where rules have them, and skin where it is in this one "
            "posture; name a trial with motion too"
        )
    doubts += [
        f"{trial}: markers of one segment are {ratio:.2f} times as far apart as in the first trial: another "
        "person, or another unit than the file tells"
        for trial, ratio in found.other_sizes.items()
    ]
    doubts += [
        f"{trial}: the body stands along {axis} there, along {found.markers.vertical} in the first trial: "
        f"taken so; solve trials like it with --up {axis}"
        for trial, axis in found.other_axes.items()
    ]
    if 1e3 * found.rmse > MOST_REST_MM:
        worst = np.argsort(found.markers.sigmas)[::-1][:4].tolist()
        doubts.append(
            f"the body meets its markers within {1e3 * found.rmse:.0f} mm, where skin leaves 3 to 10: look "
            f"for exchanged names and ghosts, first at {', '.join(found.markers.labels[m] for m in worst)}"
        )
    return doubts


def fit_notes(found: Fit, *, functional: bool) -> list[str]:
    """Return all that the user is to know of a fit, a sentence each. functional: whether ``--functional`` was
    given."""
    lengths = found.lengths_mm
    notes = _notes_on_joints(found, functional=functional) + fit_doubts(found)
    if found.trials.left_out:
        notes.append(f"no markers on {', '.join(found.trials.left_out)}: the body goes without them")
    notes += [
        f"too few markers on {', '.join(names)}: the body goes without (the trials lack {lacking})"
        for lacking, names in by_lacking(found.too_few).items()
    ]
    notes += [
        f"{left} is {lengths[left]:.0f} mm long, {right} {lengths[right]:.0f} mm: do markers of "
        f"one name sit at the same place on both sides ({found.worn_on(left)}; {found.worn_on(right)})?"
        for left, right in uneven_sides(lengths)
    ]
    if found.measured.assumed:
        taken = ", ".join(f"{name}={found.measured.lengths[name]:g}" for name in found.measured.assumed)
        notes.append(f"no file tells these, m (--measure NAME=METRES does): {taken}")
    return notes


def _notes_on_joints(found: Fit, *, functional: bool) -> list[str]:
    """Return whether rules or the motion have placed the joints, where the other would be far from it."""
    notes = []
    if found.centres.is_functional and not functional:
        notes.append(
            "joint centres are where the motion has them, as with --functional: markers are met far "
            "better so than where rules have them (--rules-only keeps to those)"
        )
    if found.centres.strained:
        away = ", ".join(f"{name} {found.moved_mm[name]:.0f} mm" for name in found.centres.strained)
        notes.append(
            f"the motion would have hips farther from their regression ({away}; regressions are off by "
            "15 to 25 mm): --functional lets it decide and meets markers within "
            f"{1e3 * found.centres.rmse_free:.1f} mm; better with trials that move hips in all directions, "
            "not with a plain walk"
        )
    return notes
