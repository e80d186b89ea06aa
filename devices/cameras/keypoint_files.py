"""Keypoints in pictures, found by other programs, as files: JSON of OpenPose's, COCO's and MMPose's kind.

OpenPose, RTMPose and AlphaPose by way of Pose2Sim, and OpenPifPaf's converters write a folder a camera with a
file a picture, ``{"people": [{"pose_keypoints_2d": [x, y, likelihood, …]}]}``. COCO's results are one list
(or the ``annotations`` of a dictionary) of ``{"image_id": …, "keypoints": [x, y, likelihood, …]}``. MMPose's
predictions are one list (or the ``instance_info`` of a dictionary) of ``{"frame_id": …, "instances":
[{"keypoints": [[x, y], …], "keypoint_scores": [likelihood, …]}]}``.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.vendor_formats.sheets import FormatError

_NUMBERS = re.compile(r"\d+")
_FIELDS = ("pose_keypoints_2d", "keypoints")
_MOST_MISSING = 10
"""Times as many pictures as there are files or entries, beyond which numbers are not those of pictures."""
_LARGEST_LIKELIHOOD = 20.0
"""Up to which scores of keypoints may be likelihoods."""
LEAST_LARGEST = 0.25
"""Below which all are scores of some other kind: nothing that is found would count as seen."""
_SURE_STEPS = 10
"""Numbers from which their common step is one, and no accident of those that are left out."""

People = tuple[NDArray[np.float64], ...]


@dataclass(frozen=True)
class PictureKeypoints:
    """The pictures of one camera."""

    path: Path
    people: tuple[People, ...]
    """Of each picture each person's (n, 3): x, y, likelihood, pixels of the picture; all zero: not found."""
    first: int = 0
    """Number of the first picture, counted in steps of the numbers: where the cameras' numbers overlap, it
    tells who began to see somebody later."""

    @property
    def n_keypoints(self) -> int:
        """Of every person; 0 where nobody is in any picture."""
        return next((len(person) for people in self.people for person in people), 0)


def is_keypoints(place: str) -> bool:
    """Return whether a path holds keypoints: a ``.json``, or a folder with such files."""
    path = Path(place)
    return (path.suffix.lower() == ".json" and path.is_file()) or (path.is_dir() and any(path.glob("*.json")))


def read_keypoints(path: Path) -> PictureKeypoints:
    """Read a folder of files, one a picture, in the order of the last numbers in their names; or one file for
    all. Pictures that numbers leave out show nobody.

    Raises ``FormatError``.
    """
    first, found = _of_folder(path) if path.is_dir() else _of_file(path)
    everybody = [person for people in found for person in people]
    _check_counts(path, everybody)
    if not everybody:
        raise FormatError(f"{path}: nobody in any of {len(found)} pictures: leave this camera out")
    _check_likelihoods(path, np.concatenate(everybody)[:, 2])
    return PictureKeypoints(path, tuple(found), first)


def _check_likelihoods(path: Path, likelihoods: NDArray[np.float64]) -> None:
    """Raise ``FormatError`` for what cannot be likelihoods from 0 to 1; those of some networks go a little
    beyond, and COCO's flags to 2."""
    if likelihoods.max() > _LARGEST_LIKELIHOOD:
        raise FormatError(
            f"{path}: likelihoods of keypoints of up to {likelihoods.max():.4g}: 0 to 1 are wanted (divide "
            "percent by 100)"
        )
    if likelihoods.max() <= 0.0:
        raise FormatError(
            f"{path}: no keypoint has a likelihood over 0, as if none had been found: give those that were "
            "found 1 where the network gives none"
        )
    if likelihoods.max() < LEAST_LARGEST:
        raise FormatError(
            f"{path}: likelihoods of keypoints of {likelihoods.max():.2g} at the most: 0 to 1 are wanted, 1 "
            "for one that is surely seen: scale them"
        )


def _check_counts(path: Path, people: Sequence[NDArray[np.float64]]) -> None:
    """Raise ``FormatError`` for people with different numbers of keypoints."""
    counts = Counter(len(person) for person in people)
    if len(counts) > 1:
        listed = " and ".join(f"{n} with {each}" for each, n in sorted(counts.items()))
        raise FormatError(f"{path}: people of different networks, or cut off: {listed} keypoints")


def _of_folder(path: Path) -> tuple[int, list[People]]:
    files = sorted(path.glob("*.json"), key=lambda each: (_number(each), each.name))
    people = [_people(_loaded(file), file) for file in files]
    usual = Counter(len(person) for each in people for person in each).most_common(1)
    for file, each in zip(files, people, strict=True):
        if each and len(each[0]) != usual[0][0]:
            raise FormatError(
                f"{file}: {len(each[0])} keypoints a person, {usual[0][0]} in most other pictures: cut off, "
                "or another network's?"
            )
    return _by_number([_number(file) for file in files], people)


def _by_number(numbers: Sequence[int], people: Sequence[People]) -> tuple[int, list[People]]:
    """Return the number of the first picture, and all pictures, with nobody in those that are left out.

    Numbers that rise in steps count those steps; where some are the same, or few of so many, they are none.
    """
    step = math.gcd(*(number - numbers[0] for number in numbers)) if len(numbers) >= _SURE_STEPS else 1
    count = (numbers[-1] - numbers[0]) // step + 1
    if len(set(numbers)) < len(numbers) or numbers[0] < 0 or count > _MOST_MISSING * len(numbers):
        return 0, list(people)
    shown = dict(zip(numbers, people, strict=True))
    return numbers[0] // step, [shown.get(numbers[0] + k * step, ()) for k in range(count)]


def _number(path: Path) -> int:
    numbers = _NUMBERS.findall(path.stem)
    return int(numbers[-1]) if numbers else -1


def _loaded(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise FormatError(
            f"{path}: cannot be read as JSON: {error}: write it again; of a folder, a picture without its "
            "file shows nobody"
        ) from error


def _people(content: Any, file: Path) -> People:
    if not isinstance(content, dict) or not isinstance(content.get("people"), list):
        raise FormatError(f"{file}: no list 'people': files of OpenPose's kind have one")
    people = _seen(content["people"], file)
    _check_counts(file, people)
    return people


def _of_file(path: Path) -> tuple[int, list[People]]:
    content = _loaded(path)
    if isinstance(content, dict) and "people" in content:
        return 0, [_people(content, path)]
    entries = content
    if isinstance(content, dict):
        entries = content.get("annotations", content.get("instance_info"))
    if not isinstance(entries, list) or not all(isinstance(each, dict) for each in entries):
        raise FormatError(
            f"{path}: neither 'people' of OpenPose, nor a list of COCO's results or of MMPose's predictions"
        )
    by_picture: dict[int, list[NDArray[np.float64]]] = {}
    for entry in entries:
        shown = entry["instances"] if isinstance(entry.get("instances"), list) else [entry]
        by_picture.setdefault(_picture_of(entry, path), []).extend(_seen(shown, path))
    if not by_picture:
        raise FormatError(f"{path}: an empty list")
    numbers = sorted(by_picture)
    return _by_number(numbers, [tuple(by_picture[number]) for number in numbers])


def _picture_of(entry: dict[str, Any], path: Path) -> int:
    image_id = entry.get("image_id", entry.get("frame_id"))
    numbers = _NUMBERS.findall(Path(str(image_id)).stem)
    if not numbers:
        raise FormatError(f"{path}: image_id {image_id!r} has no number: pictures are put in order by it")
    return int(numbers[-1])


def _seen(entries: Sequence[Any], path: Path) -> People:
    """Return all people but those of whom an empty list tells that no keypoint was found."""
    return tuple(person for each in entries if len(person := _person(each, path)))


def _person(entry: Any, path: Path) -> NDArray[np.float64]:
    given = entry if isinstance(entry, dict) else {}
    values = next((given[field] for field in _FIELDS if field in given), None)
    try:
        found = np.array(values, dtype=np.float64)
        if (scores := given.get("keypoint_scores")) is not None:
            found = np.column_stack([found.reshape(-1, 2), np.array(scores, dtype=np.float64)])
        found = found.reshape(-1, 3)
    except (TypeError, ValueError) as error:
        raise FormatError(
            f"{path}: a person without {' or '.join(_FIELDS)}, a list of x, y and likelihood by turns (or of "
            "x and y, with a list keypoint_scores)"
        ) from error
    found[np.isnan(found).any(axis=1)] = 0.0  # how some programs write what they have not found
    if not np.isfinite(found).all():
        raise FormatError(f"{path}: infinite keypoints: one that was not found is 0, 0, 0")
    return found
