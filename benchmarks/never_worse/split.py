"""The recordings by part of the split, and the case of a name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from benchmarks.never_worse import store
from benchmarks.never_worse.case import Case, in_turned_world
from benchmarks.never_worse.losses import with_knocks, with_losses, with_noise, with_silences
from benchmarks.never_worse.recordings import FAMILIES
from benchmarks.never_worse.simulated import KINDS
from gateway.frames import ANGULAR_RATE, INERTIAL_SAMPLE, SPECIFIC_FORCE
from gateway.stages.clipping import RangeWatch

FILE = Path(__file__).with_name("split.yaml")
PARTS = ("training", "validation")
CHANGES: dict[str, Callable[[Case, str], Case]] = {
    "_lossy": with_losses,
    "_silent": with_silences,
    "_noisy": with_noise,
    "_knocked": with_knocks,
    "_turned": in_turned_world,
}
"""End of a recording's name to what has happened to it; called with the whole name."""


class Named(NamedTuple):
    """A recording of the split."""

    name: str
    part: str
    reason: str


def table() -> dict[str, Any]:
    """Return the split as it stands in its file."""
    content: dict[str, Any] = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    return content


def named(*parts: str) -> list[Named]:
    """Return all recordings of some parts, seeds as names of their own."""
    content, found = table(), []
    for part in parts or PARTS:
        found += [Named(name, part, reason) for name, reason in content[part]["recordings"].items()]
        for kind, drawn in content[part]["simulated"].items():
            found += [Named(f"{kind}_{seed}", part, drawn["reason"]) for seed in drawn["seeds"]]
    return found


def case(name: str) -> Case:
    """Return the case of that name, kept on disk. Raises ``FileNotFoundError`` or ``ValueError`` where the
    recording is not there."""
    return store.kept(f"case-{name}-{store.code_digest()}", lambda: _watched(_made(name)))


def _watched(case: Case) -> Case:
    """Return the case with samples marked that are at the end of a range, as the service marks them."""
    n_modules = len(case.frames[0].specific_force)
    samples = np.zeros((len(case.frames), n_modules), INERTIAL_SAMPLE)
    samples["module"], samples["sequence"] = np.arange(n_modules), np.arange(len(case.frames))[:, None]
    samples["measured"][:, :, SPECIFIC_FORCE] = [frame.specific_force for frame in case.frames]
    samples["measured"][:, :, ANGULAR_RATE] = [frame.angular_rate for frame in case.frames]
    is_there = np.isfinite(samples["measured"][:, :, ANGULAR_RATE]).all(axis=2)
    clipped = np.zeros(samples.shape, np.uint8)
    clipped[is_there] = RangeWatch({}).add(samples[is_there])["clipped"]
    frames = [replace(frame, clipped=ends) for frame, ends in zip(case.frames, clipped, strict=True)]
    return replace(case, frames=frames)


def _made(name: str) -> Case:
    for end, change in CHANGES.items():
        if name.endswith(end):
            return change(_made(name.removesuffix(end)), name)
    kind, _, seed = name.rpartition("_")
    if kind in KINDS:
        return KINDS[kind](int(seed))
    return FAMILIES[name.partition("_")[0]](name)
