"""One marker, many spellings.

``LASI``, ``lasi``, ``Bob:LASI``, ``Bob_LASI``, ``LASI_2``, ``L.ASIS``, ``ASIS_L`` and ``Left ASIS``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from shlex import quote

from devices.marker_files.trial import MarkerTrial
from devices.vendor_formats.sheets import FormatError

_PREFIX = re.compile(r"([^:]+(?=:)|[^:_.\s-]+)[:_.\s-]+(.+)")
"""What precedes a colon, blanks and all (``Anna Lee:LASI``); else the first word."""
_PERSON_BEHIND = re.compile(r"(.+)[:_.\s-]+([^:_.\s-]+)")
_SIDES = frozenset({"l", "r", "left", "right"})
_SIDE = re.compile(r"(?:(left|right)[\W_]*)?(.+?)(?:[\W_]+(left|right|l|r))?", re.IGNORECASE)
"""Written out before a marker's name (``LeftASIS`` too), or behind it."""
_NOT_SPELT = re.compile(r"[\W_]+")
_ONE_MORE = 3
"""A prefix is a person's name if so many more markers are known without it."""


def plain(label: str) -> str:
    """Return a label without case and punctuation, l or r first where its side is written out or behind."""
    match = _SIDE.fullmatch(label.strip())
    if match is not None and (match[1] is None) != (match[3] is None):
        label = (match[1] or match[3])[0] + match[2]
    return _NOT_SPELT.sub("", label).casefold()


def spelt(
    trial: MarkerTrial,
    wanted: Iterable[str],
    others: Mapping[str, str] | None = None,
    person: str | None = None,
) -> MarkerTrial:
    """Return the trial with its markers named as ``wanted``, where its file spells them otherwise.

    Arguments and ``FormatError`` as of ``spellings``. Labels that are no spelling of a wanted one stay;
    another person's markers that bear the name of a wanted one are left out.
    """
    found = spellings(trial.labels, wanted, others, person, trial.name)
    names = set(found.values())
    kept = [m for m, label in enumerate(trial.labels) if label in found or label not in names]
    labels = tuple(found.get(trial.labels[m], trial.labels[m]) for m in kept)
    if len(kept) == len(trial.labels):
        return replace(trial, labels=labels)
    return replace(trial, labels=labels, positions=trial.positions[:, kept])


def spellings(
    labels: Sequence[str],
    wanted: Iterable[str],
    others: Mapping[str, str] | None = None,
    person: str | None = None,
    source: str = "the stream",
) -> dict[str, str]:
    """Return which label stands for which of ``wanted``.

    others: further names, each with the label wanted. person: whose markers, by the prefix that they have;
    None: of the one whose prefix all wanted labels have, else of the only one. Raises ``FormatError``,
    which names ``source``, when the markers of several people fit, or nobody is called ``person``.
    """
    own = tuple(wanted)
    owner = person or _owner(own)
    meant = {plain(name): label for name, label in (others or {}).items()}
    meant |= {plain(bare): label for bare, label in zip(_bare(own), own, strict=True)}
    meant |= {plain(label.rpartition(":")[2]): label for label in own}
    meant |= {plain(_without(label, _owner(own))): label for label in own}
    # The closest spelling comes last, and so replaces looser ones.
    meant |= {plain(label): label for label in own}
    if people := _people_behind(labels, meant, person):
        first = {_person_first(label, people): label for label in labels}
        mine = {_person_first(label, people): label for label in own}
        found = spellings(list(first), mine, others, person, source)
        return {first[label]: mine[name] for label, name in found.items()}
    bare = dict(zip(labels, _barest(labels, meant), strict=True))
    if person is None and _known(bare.values(), meant) > _known(labels, meant) + _ONE_MORE:
        return _first_of_each(
            {label: meant[plain(name)] for label, name in bare.items() if plain(name) in meant}
        )
    taken = set(own) & set(labels) if person is None else set()
    found = {label: label for label in taken}
    prefix = _prefix_of(labels, meant, taken, person, owner, source)
    for label in labels:
        if not label or label in found or (person is not None and _is_of_another(label, prefix, meant)):
            continue
        name = meant.get(plain(_without(label, prefix)))
        if name is not None and name not in taken:
            found[label] = name
            taken.add(name)
    return found


def _people_behind(labels: Sequence[str], meant: Mapping[str, str], person: str | None) -> set[str]:
    """Return who wears markers whose names end in a person's (``LASI_1``, ``LASI_2``).

    Nobody where fewer than two people have enough of them, unless it is a ``person`` who is asked for.
    """
    split = [match for label in labels if (match := _PERSON_BEHIND.fullmatch(label)) is not None]
    if person is not None and not any(label.startswith(person) for label in labels):
        everybody = {match[2] for match in split}
        return everybody if person in everybody else set()
    counts = Counter(
        match[2] for match in split if plain(match[1]) in meant and match[2].lower() not in _SIDES
    )
    without = sum(plain(label) in meant for label in labels)
    people = {person for person, count in counts.items() if count >= max(without, 1) and count >= _ONE_MORE}
    return people if len(people) > 1 else set()


def _person_first(label: str, people: Collection[str]) -> str:
    """Return a label with the person before the marker."""
    match = _PERSON_BEHIND.fullmatch(label)
    return f"{match[2]}:{match[1]}" if match is not None and match[2] in people else label


def _barest(labels: Sequence[str], meant: Mapping[str, str]) -> list[str]:
    """Return labels as ``_bare`` does, also without letters before them that all share (``AnaLASI``) where
    more of the wanted ones are known so."""
    bare = _bare(labels)
    named = [label for label in bare if label and not label.startswith("*")]
    shared = _shared(named) if len(named) > _ONE_MORE else 0
    shorter = ([label[n:] if label in named else label for label in bare] for n in range(1, shared + 1))
    return max([bare, *shorter], key=lambda each: _known(each, meant))


def _bare(labels: Sequence[str]) -> list[str]:
    """Return labels without what precedes and follows all that are names (``Anna_Lee_LASI``, ``LASI-1``)."""
    named = [label for label in labels if label and not label.startswith("*")]
    if len(named) <= _ONE_MORE:
        return list(labels)
    first = _shared_mark(named)
    last = _shared_mark([label[::-1] for label in named])
    return [label[first : len(label) - last] if label in named else label for label in labels]


def _shared_mark(texts: Sequence[str]) -> int:
    """Return how many characters all texts begin with, up to the last that is no letter and no digit."""
    return max((n for n in range(1, _shared(texts) + 1) if not texts[0][n - 1].isalnum()), default=0)


def _shared(texts: Sequence[str]) -> int:
    """Return how many characters all texts begin with."""
    # The first and last in alphabetical order differ soonest: what they share, all share.
    first, last = min(texts), max(texts)
    return next((n for n, pair in enumerate(zip(first, last, strict=False)) if len({*pair}) > 1), len(first))


def _known(labels: Iterable[str], meant: Mapping[str, str]) -> int:
    """Return how many of the wanted labels some labels stand for."""
    return len({meant[name] for name in map(plain, labels) if name in meant})


def _first_of_each(found: Mapping[str, str]) -> dict[str, str]:
    """Return only the first label that stands for each wanted one."""
    firsts: dict[str, str] = {}
    for label, name in found.items():
        firsts.setdefault(name, label)
    return {label: name for name, label in firsts.items()}


def _owner(labels: Sequence[str]) -> str | None:
    """Return the prefix that all of some labels share, or None."""
    prefixes = {match[1] if (match := _PREFIX.fullmatch(label)) else None for label in labels}
    return prefixes.pop() if len(prefixes) == 1 and len(labels) >= _ONE_MORE else None


def _is_of_another(label: str, prefix: str | None, meant: Mapping[str, str]) -> bool:
    """Return whether a label is that of a wanted marker behind another person's name."""
    match = _PREFIX.fullmatch(label)
    return match is not None and match[1] != prefix and plain(match[2]) in meant


def _prefix_of(
    labels: Sequence[str],
    meant: Mapping[str, str],
    taken: set[str],
    person: str | None,
    owner: str | None,
    source: str,
) -> str | None:
    """Return the person's name that precedes the wanted labels; None where nothing does."""
    split = [match for match in map(_PREFIX.fullmatch, labels) if match is not None]
    if person is not None:
        everyone = dict.fromkeys(match[1] for match in split)
        if person not in everyone:
            known = f"there are {', '.join(everyone)}" if everyone else "none has a person's name before it"
            raise FormatError(f"{source}: no markers begin with '{person}': {known}")
        return person
    prefixes = Counter(match[1] for match in split if plain(match[2]) in meant)
    without = len(taken) + sum(plain(label) in meant for label in labels if label not in taken)
    people = [prefix for prefix, count in prefixes.items() if count >= max(without, 1) and count >= _ONE_MORE]
    if owner in prefixes:
        return owner
    if len(people) > 1:
        raise FormatError(
            f"{source}: markers of {' and '.join(people)}: tell whose are meant with --person "
            f"{quote(people[0])}"
        )
    return people[0] if people else None


def _without(label: str, prefix: str | None) -> str:
    match = _PREFIX.fullmatch(label) if prefix is not None else None
    return match[2] if match is not None and match[1] == prefix else label


def without_prefixes(labels: Sequence[str]) -> tuple[str, ...]:
    """Return labels without a subject's name and colon before them, unless two would then be the same."""
    bare = [label.rpartition(":")[2].strip() for label in labels]
    named = {label.strip(): name for label, name in zip(labels, bare, strict=True) if name and name[0] != "*"}
    if len(set(named.values())) < len(named):
        return tuple(label.strip() for label in labels)
    return tuple(bare)
