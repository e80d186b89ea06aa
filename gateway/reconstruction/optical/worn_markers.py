"""What of a marker set a person wears: which set it is, under which names, on which part of the body."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from devices.marker_files import MarkerTrial
from devices.marker_files.naming import spellings, spelt
from devices.marker_files.trial import METRES
from gateway.body.skeleton import reduced
from gateway.errors import GatewayError
from gateway.reconstruction.optical.ghosts import sides_kept, without_ghosts
from gateway.reconstruction.optical.marker_set import MarkerSet, PointRule, load_marker_set, names_in
from gateway.support.settings_files import shipped_folder

_ENOUGH = 6
"""Markers of a set that trials must have for the set to be taken unasked."""
_NAMED = 12
"""Of a file's markers in a message."""
_SIZES_M = 0.02, 20.0
"""Between them lies the size of whatever wears markers."""
_USUAL_M = 1.5
_PERSON_M = 0.25, 4.0
"""Likewise of a person, or of a part of one that carries ``_ENOUGH`` markers."""


@dataclass(frozen=True)
class NamedTrials:
    """Trials whose markers are called as in a marker set, and the part of the set that is in them."""

    marker_set: MarkerSet
    trials: tuple[MarkerTrial, ...]
    file_labels: dict[str, str]
    """Marker of the set to its name in the files."""
    left_out: tuple[str, ...]
    """Segments of the set's body that carry none of the markers."""
    ghosts: Mapping[str, int] = field(default_factory=dict)
    """Points that were left out since they lie far from the markers beside them, by name in the files."""
    strangers: tuple[str, ...] = ()
    """Names in the files that are none of the set's."""
    exchanged: Mapping[str, int] = field(default_factory=dict)
    """Frames in which a left marker had the name of the right one, by its name in the files."""


def named_trials(
    marker_set: MarkerSet, trials: Sequence[MarkerTrial], person: str | None = None
) -> NamedTrials:
    """Return trials with their markers called as in the set, and the set without what is in none of them.

    person: as in ``spelt``. Raises ``FormatError`` as that does, ``GatewayError`` for a trial without any
    marker of the set.
    """
    names: dict[str, str] = {}
    called: list[MarkerTrial] = []
    ghosts, exchanged = Counter[str](), Counter[str]()
    for own in trials:
        trial = spelt(own, marker_set.labels, marker_set.other_names, person)
        seen = _seen(trial, marker_set.labels)
        if not seen:
            raise GatewayError(_stranger(marker_set, own, trial))
        meant = spellings(own.labels, marker_set.labels, marker_set.other_names, person, own.name)
        names = {name: label for label, name in meant.items() if name in seen} | names
        trial, swapped = sides_kept(marker_set, trial)
        exchanged.update({names[name]: count for name, count in swapped.items()})
        trial, found = without_ghosts(marker_set, trial)
        ghosts.update({names[name]: count for name, count in found.items()})
        _refuse_wrong_unit(trial, marker_set)
        called.append(trial)
    worn = worn_part(marker_set, names)
    _refuse_bare_root(marker_set, worn, called[0])
    left_out = tuple(name for name in marker_set.body.segment_names if name not in worn.body.segment_names)
    own_names = dict.fromkeys(label for trial in trials for label in trial.labels if label)
    strangers = tuple(
        name for name in own_names if name not in {*names.values()} and not name.startswith("*")
    )
    return NamedTrials(worn, tuple(called), names, left_out, dict(ghosts), strangers, dict(exchanged))


def worn_part(marker_set: MarkerSet, labels: Collection[str], without: Collection[str] = ()) -> MarkerSet:
    """Return the set with these markers only, and its body without the limbs that carry none of them.

    The body hangs from its root, or, where that carries none of the markers, from the segment from which all
    hang that do. Segments to which the set itself gives no marker stay where they follow one that stays, and
    are not among those that are to go (``without``).
    """
    file, body = marker_set.file, marker_set.body
    markers = {segment: [label for label in own if label in labels] for segment, own in file.markers.items()}
    carrying = [s for s, name in enumerate(body.segment_names) if markers.get(name)]
    hung = [] if file.markers.get(body.segment_names[0]) and 0 not in carrying else [0]
    part = reduced(body, [*hung, *carrying])
    following = [
        s for s, name in enumerate(body.segment_names)
        if name not in without
        and not file.markers.get(name)
        and body.segment_names[body.parents[s]] in part.segment_names
    ]  # fmt: skip
    part = reduced(body, [*hung, *carrying, *following])
    kept = part.segment_names
    segments = {segment: rule for segment, rule in file.segments.items() if segment in kept}
    if not hung and (axes := segments[kept[0]].axes) is not None:
        segments[kept[0]] = segments[kept[0]].model_copy(update={"origin": axes.primary[1]})
    changes = {
        "markers": {segment: own for segment, own in markers.items() if own and segment in kept},
        "segments": segments,
        "points": {point: _first_worn(marker_set, point, labels) for point in file.points},
    }
    return marker_set.model_copy(update={"file": file.model_copy(update=changes), "body": part})


def _first_worn(marker_set: MarkerSet, point: str, labels: Collection[str]) -> list[PointRule]:
    """Return the rules of a point that rest on the markers of the first rule whose markers are worn.

    A landmark that one trial alone shows (a medial marker in the static trial) so holds for all: another rule
    would put the joint elsewhere in the others.
    """
    rules = marker_set.rules(point)
    rests = [set(names_in(getattr(rule, rule.kind))) & {*marker_set.labels} for rule in rules]
    worn = next((own for own in rests if own <= {*labels}), rests[0])
    return [rule for rule, own in zip(rules, rests, strict=True) if own == worn]


def fitting_set(trials: Sequence[MarkerTrial], person: str | None = None) -> MarkerSet:
    """Return the shipped marker set of which the trials have most markers; of equals the smallest.

    Raises ``GatewayError`` that names the shipped ones where the trials have hardly a marker of any.
    """
    names = sorted(path.stem for path in (shipped_folder() / "marker_sets").glob("*.yaml"))
    best, most, named = None, (0, 0), 0
    for marker_set in map(load_marker_set, names):
        known = set()
        for trial in trials:
            called = spelt(trial, marker_set.labels, marker_set.other_names, person)
            known |= _seen(called, marker_set.labels)
            named = max(named, len({*marker_set.labels} & {*called.labels}))
        if (score := (len(known), -len(marker_set.labels))) > most:
            best, most = marker_set, score
    if most[0] < _ENOUGH <= named:
        raise GatewayError(_never_seen(trials[0], named, most[0]))
    if not any(label and not label.startswith("*") for label in trials[0].labels):
        raise GatewayError(
            f"{trials[0].name}: none of its {len(trials[0].labels)} points has a name: name the markers in "
            "the program that recorded them, and export the trial again"
        )
    if best is None or most[0] < _ENOUGH:
        raise GatewayError(
            f"{trials[0].name}: its markers are those of no shipped set ({', '.join(names)}): it has "
            f"{_some_labels(trials[0].labels)}; describe them in a file and name it with --set"
        )
    return best


def _seen(trial: MarkerTrial, labels: Sequence[str]) -> set[str]:
    places = trial.columns(tuple(labels))
    return {label for m, label in enumerate(labels) if np.isfinite(places[:, m]).all(axis=1).any()}


def _refuse_bare_root(marker_set: MarkerSet, worn: MarkerSet, trial: MarkerTrial) -> None:
    """Raise ``GatewayError`` where the segment from which a worn part hangs has no marker, or no axes."""
    root = worn.body.segment_names[0]
    own = marker_set.file.markers.get(root, [])
    if own and not (worn.file.markers.get(root) and worn.file.segments[root].axes):
        strangers = [label for label in trial.labels if label and label not in marker_set.labels]
        alike = [label for label in strangers if any(label.casefold().startswith(o.casefold()) for o in own)]
        raise GatewayError(
            f"{trial.name}: {len(worn.labels)} markers of '{marker_set.file.name}', the nearest set, and "
            f"none of its {root} ({', '.join(own)}), from which the body hangs; "
            + (
                f"rename {', '.join(alike[:_NAMED])} where they are those, else describe "
                if alike
                else f"it has {_some_labels(strangers or trial.labels)}: describe "
            )
            + "its markers in a file and name it with --set"
        )


def _stranger(marker_set: MarkerSet, trial: MarkerTrial, called: MarkerTrial) -> str:
    name, known = marker_set.file.name, _some_labels(trial.labels)
    if named := len({*marker_set.labels} & {*called.labels}):
        return _never_seen(trial, named, 0)
    return (
        f"{trial.name}: none of the markers of '{name}' is in it; it has {known}: name its markers in the "
        "program that recorded them, or leave this trial out"
    )


def _never_seen(trial: MarkerTrial, named: int, seen: int) -> str:
    return (
        f"{trial.name}: {named} markers by their names, of which {seen} are seen: its points are empty, zero "
        "or farther than 1 km from the origin; export the trial again"
    )


def _refuse_wrong_unit(trial: MarkerTrial, marker_set: MarkerSet) -> None:
    places = trial.columns(tuple(marker_set.labels))
    places = places[:, np.isfinite(places).all(axis=(0, 2))]
    if places.shape[1] < _ENOUGH:
        return
    extent = float(np.median(np.ptp(places, axis=1).max(axis=1)))
    smallest, largest = _SIZES_M if marker_set.body.stature_m is None else _PERSON_M
    if not smallest < extent < largest:
        units = {name: extent / trial.metres_per_unit * metres for name, metres in METRES.items()}
        likely = min(units, key=lambda name: abs(np.log(units[name] / _USUAL_M)) if extent > 0 else 0.0)
        is_likely = 0.5 * _USUAL_M < units[likely] < 2.0 * _USUAL_M
        better = f"; {likely} would make it {units[likely]:.2f} m" if is_likely else ""
        raise GatewayError(
            f"{trial.name}: its markers reach over {extent:.4g} m, in a unit of {trial.metres_per_unit:g} m: "
            f"correct the unit in the file (POINT:UNITS, or Units{better})"
        )


def _some_labels(labels: Sequence[str]) -> str:
    named = [label for label in labels if label and not label.startswith("*")]
    return ", ".join(named[:_NAMED]) + (", …" if len(named) > _NAMED else "") or "no named markers"
