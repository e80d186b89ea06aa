"""``python -m benchmarks.sensitivity``: what each number of the estimator, and each rule of thumb, is worth.

Every constant of the tuning table is halved and doubled, and every rule of thumb of the estimator's page
switched off, one at a time; each time `joint` solves a few recordings anew and is judged against their truth.
They are of the training part alone, so that what is chosen by the figures may still be judged by the
validation part: the first recording of each family and the first seed of each simulated kind, in the order of
the split's file, the first minute of each.

Results are kept in ``build/sensitivity.json``, each as soon as it is known and with the fingerprint of the
estimator's code: a run that was broken off goes on where it was, and one after a change begins anew.

::

    python -m benchmarks.sensitivity                         all that is missing
    python -m benchmarks.sensitivity --only huber bias       these constants or rules
    python -m benchmarks.sensitivity --write                 the page, of what is known
"""

from __future__ import annotations

import gateway  # noqa: F401 - before NumPy: settles which instructions it takes

# isort: split
import argparse
import json
import math
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.progress import track

from benchmarks.never_worse import split
from benchmarks.never_worse.case import Case, Variant
from benchmarks.never_worse.judging import errors
from benchmarks.never_worse.objective import fair_vqf, score
from benchmarks.never_worse.simulated import KINDS
from benchmarks.never_worse.solving import OURS, live
from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.kernel_fingerprint import fingerprint
from gateway.reconstruction.inertial.tree import prediction, reconstructor, rows, step, unaided
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings
from gateway.reconstruction.inertial.tree.state import (
    Body,
    Segment,
    SegmentWork,
    State,
    Vibration,
    Work,
    World,
    chain_body,
)
from gateway.reconstruction.inertial.tree.tuning import CONSTANTS, Tuning, tuning
from gateway.reconstruction.inertial.tree.vibration import watch_vibration

REPOSITORY = Path(__file__).resolve().parents[1]
STORE = REPOSITORY / "build" / "sensitivity.json"
PAGE = REPOSITORY / "docs" / "explanation" / "estimator_sensitivity.md"
SECONDS = 60.0
"""Of each recording."""
NOTHING_PERCENT = 0.1
"""A figure that changes by less has not moved."""
ENDLESS = 1e9
"""s, or times: for ever."""
DEFAULT = "default"


class Rule(NamedTuple):
    """A rule of thumb of the page's section 17, and how it is switched off."""

    what: str
    equations: str
    changes: Mapping[str, float] = {}
    """Of the tuning."""
    patch: Callable[[], None] | None = None
    """Of the code, in a process of its own, before any kernel is compiled."""
    is_by_interval: bool = False
    """Whether the values of ``changes`` are times the recording's sampling interval."""


def _without_shocks() -> None:
    @compiled
    def watch(
        seen: Vibration, x: FloatArray, is_fresh: bool, floor: float, shock: float, tuning: Tuning, dt: float
    ) -> None:
        watch_vibration(seen, x, is_fresh, floor, ENDLESS, tuning, dt)

    prediction.watch_vibration = watch  # type: ignore[attr-defined]


def _without_second_order() -> None:
    @compiled
    def second_order_variance(
        child: Segment, parent: Segment, u: object, tuning: Tuning, interval_s: float
    ) -> float:
        return 0.0

    rows.second_order_variance = second_order_variance  # type: ignore[attr-defined, assignment]


def _without_unaided() -> None:
    @compiled
    def speed_row(
        now: SegmentWork, segment: Segment, world: World, look: float, sharing: int, tuning: Tuning
    ) -> None:
        return

    unaided.speed_row = speed_row


def _without_stance() -> None:
    @compiled
    def stance_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
        return

    step.stance_rows = stance_rows  # type: ignore[attr-defined]


def _without_defined_headings() -> None:
    @compiled
    def define_headings(body: Body, state: State, tuning: Tuning) -> None:
        return

    step.define_headings = define_headings  # type: ignore[attr-defined]


def _without_open_headings() -> None:
    def body_of(*arguments: object) -> Body:
        body = chain_body(*arguments)  # type: ignore[arg-type]
        body.segments["heading_observable"][...] = 0
        return body

    reconstructor.chain_body = body_of  # type: ignore[attr-defined]


RULES = {
    "memory": Rule("errors of a row stay for τ_m", "(15)", {"row_memory_s": 1.0}, is_by_interval=True),
    "huber": Rule("outliers count linearly", "(17)", {"huber": ENDLESS}),
    "nis": Rule("inflation by NIS", "(22)", {"largest_nis": 1.0}),
    "corrections": Rule("inflation by the filter's corrections", "(58) to (61)", {"correction_gain": 0.0}),
    "vibration": Rule("vibration is measured", "(12)", {"vibration_memory_s": ENDLESS}),
    "shocks": Rule("readings that jump are shocks", "(12a), (12b)", patch=_without_shocks),
    "second_order": Rule("second order as variance", "(21)", patch=_without_second_order),
    "disturbed_field": Rule(
        "a field whose norm or dip is wrong counts less", "D of (31)",
        {"norm_tolerance": ENDLESS, "dip_tolerance": ENDLESS},
    ),
    "unaided": Rule("speeds of an unaided body are bounded", "(39) to (40)", patch=_without_unaided),
    "seen": Rule("speeds are seen", "(40a)", {"speed_mean_s": ENDLESS}),
    "taken_back": Rule("headings are taken back", "section 12", {"heading_contradiction": ENDLESS}),
    "starting": Rule("a start in motion is told by its first sample", "(65)", {"starting_share": 0.0}),
    "zero_rate": Rule("zero rate", "(36)", {"zero_rate_s": ENDLESS}),
    "stance": Rule("zero acceleration", "(37), (38)", patch=_without_stance),
    "defined": Rule("a body's own heading is defined", "(57a)", patch=_without_defined_headings),
    "open_headings": Rule("unobserved headings in closed form", "(54) to (57)", patch=_without_open_headings),
}  # fmt: skip
"""By name."""


class Outcome(NamedTuple):
    """What a try was worth, by recording and variant."""

    kinds: dict[str, str]
    """Of the recordings."""
    total: dict[str, float]
    """``recording/variant``: degrees."""
    tilt: dict[str, float]
    ratio: dict[str, float]
    """Over VQF."""


class Try(NamedTuple):
    """Changes that are judged together."""

    name: str
    changes: Mapping[str, float]
    rule: str = ""


def tries() -> list[Try]:
    """Return all, the defaults first."""
    found = [Try(DEFAULT, {})]
    for name, row in CONSTANTS.items():
        found += [Try(f"{name} × {factor:g}", {name: factor * row.default}) for factor in (0.5, 2.0)]
    return found + [Try(f"without {name}", rule.changes, name) for name, rule in RULES.items()]


def recordings() -> list[str]:
    """Return the names of the first recording of each family and kind of the training part."""
    first: dict[str, str] = {}
    for one in split.named("training"):
        kind, _, seed = one.name.rpartition("_")
        is_simulated = seed.isdigit() and kind in KINDS
        first.setdefault(kind if is_simulated else one.name.partition("_")[0], one.name)
    return list(first.values())


@cache
def beginning(name: str) -> Case:
    """Return the first part of a recording."""
    case = split.case(name)
    n = min(len(case.frames), round(SECONDS / case.interval_s))
    return replace(case, frames=case.frames[:n], truth=case.truth[:n], truth_later=case.truth_later[:n])


@cache
def vqf(name: str, variant: Variant) -> float:
    """Return the error of VQF, degrees: it does not change from one try to the next."""
    return fair_vqf(beginning(name), variant)


def outcome(one: Try, names: Sequence[str]) -> Outcome:
    """Judge a try on recordings."""
    found = Outcome({}, {}, {}, {})
    for name in names:
        case = beginning(name)
        found.kinds[name] = case.kind
        scale = case.interval_s if one.rule and RULES[one.rule].is_by_interval else 1.0
        settings = ChainSettings(tuning=tuning(**{key: v * scale for key, v in one.changes.items()}))
        for variant in case.variants:
            error = errors(case, variant, live(OURS, case, variant, settings).q_wb)
            key = f"{name}/{variant}"
            found.total[key], found.tilt[key] = error.total, error.tilt
            found.ratio[key] = error.total / vqf(name, variant)
    return found


def code() -> str:
    """Return the fingerprint of the estimator's kernels and defaults."""
    kernel = fingerprint([step.advance.kernel_function])  # type: ignore[attr-defined]
    return f"{kernel} {hash(tuple(row.default for row in CONSTANTS.values())) & 0xFFFFFFFF:08x}"


def known() -> dict[str, Outcome]:
    """Return what has been found out about the code as it is, by the tries' names."""
    if not STORE.exists():
        return {}
    kept = json.loads(STORE.read_text(encoding="utf-8"))
    return {name: Outcome(**each) for name, each in kept["tries"].items()} if kept["code"] == code() else {}


def keep(results: Mapping[str, Outcome]) -> None:
    """Write results down, whole at any instant."""
    STORE.parent.mkdir(exist_ok=True)
    part = STORE.with_suffix(".part")
    content = {"code": code(), "tries": {name: each._asdict() for name, each in results.items()}}
    part.write_text(json.dumps(content, indent=1), encoding="utf-8")
    part.replace(STORE)


def run(wanted: Sequence[Try], names: Sequence[str]) -> None:
    """Judge what is not known yet, one after the other."""
    results = known()
    missing = [one for one in wanted if one.name not in results]
    for one in track(missing, description="tries"):
        if one.rule and RULES[one.rule].patch is not None:
            made = subprocess.run(
                [sys.executable, "-m", "benchmarks.sensitivity", "--patched", one.rule, *names],
                check=True, capture_output=True, text=True,
            )  # fmt: skip
            results[one.name] = Outcome(**json.loads(made.stdout.splitlines()[-1]))
        else:
            results[one.name] = outcome(one, names)
        keep(results)


def patched(name: str, names: Sequence[str]) -> None:
    """Print the outcome of a rule that code stands for, switched off in this process."""
    rule = RULES[name]
    assert rule.patch is not None
    rule.patch()
    print(json.dumps(outcome(Try(f"without {name}", rule.changes, name), names)._asdict()))


class Effect(NamedTuple):
    """Of a try, against the defaults."""

    total: float
    """%, geometric mean over the variants of a recording, over the recordings."""
    tilt: float
    score: float
    """Of the objective's value, less is better."""
    worst: float
    """%: of the error of that recording and variant which it hurts most."""
    where: str

    @property
    def moves(self) -> bool:
        """Whether it changes anything."""
        return max(abs(self.total), abs(self.tilt), abs(self.worst)) >= NOTHING_PERCENT


def effect(default: Outcome, one: Outcome) -> Effect:
    """Return what a try does to the figures."""

    def percent(before: Mapping[str, float], after: Mapping[str, float]) -> float:
        return 100.0 * (math.exp(np.mean([math.log(after[key] / before[key]) for key in before])) - 1.0)

    worst = max(default.total, key=lambda key: one.total[key] / default.total[key])
    change = objective(one) - objective(default)
    hurt = 100.0 * (one.total[worst] / default.total[worst] - 1.0)
    return Effect(percent(default.total, one.total), percent(default.tilt, one.tilt), change, hurt, worst)


def objective(one: Outcome) -> float:
    """Return the number that settings are chosen by."""
    found: dict[str, tuple[str, dict[Variant, float]]] = {}
    for key, ratio in one.ratio.items():
        name, _, variant = key.partition("/")
        by_name = {str(each): each for each in beginning(name).variants}
        found.setdefault(name, (one.kinds[name], {}))[1][by_name[variant]] = ratio
    return score(found).value


def page() -> Iterator[str]:
    """Yield the page's lines."""
    results = known()
    if DEFAULT not in results:
        raise SystemExit("nothing is known of this code yet: run `python -m benchmarks.sensitivity`")
    default, all_tries = results[DEFAULT], tries()
    done = sum(one.name in results for one in all_tries)
    effects = {one.name: effect(default, results[one.name]) for one in all_tries if one.name in results}
    yield from _preface(default, done, len(all_tries))
    yield from _rules_table(effects)
    yield from _constants_table(effects)


def _preface(default: Outcome, done: int, n_tries: int) -> Iterator[str]:
    """Yield what was tried on what, and what the columns mean."""
    yield "# What each number of the estimator is worth"
    yield ""
    yield (
        f"By `python -m benchmarks.sensitivity --write`; {done} of {n_tries} tries are known of the "
        f"code whose fingerprint is `{code()}`."
    )
    yield ""
    yield (
        "Each constant of the tuning table was halved (½) and doubled (2), and each rule of thumb of "
        "[the model](estimator.md) was switched off, one at a time. Every try was judged on the first "
        "minute of the first recording of each kind of the training part, with and without field and devices:"
    )
    yield ""
    yield f"{', '.join(f'`{name}`' for name in default.kinds)}."
    yield ""
    yield "- **total, tilt**: change of the error, %, geometric mean over all recordings."
    yield "- **objective**: change of the number that settings are chosen by (mean ratio to VQF and penalty)."
    yield "- **worst**: change of the error of the recording that suffers most, %."
    yield ""
    yield "Less is better in all columns."
    yield ""


def _rules_table(effects: Mapping[str, Effect]) -> Iterator[str]:
    """Yield the effect of each rule of thumb."""
    yield "## Rules of thumb, switched off"
    yield ""
    yield "| rule | equations | total | tilt | objective | worst | where |"
    yield "|---|---|---|---|---|---|---|"
    for name, rule in RULES.items():
        if (one := effects.get(f"without {name}")) is not None:
            yield f"| {rule.what} | {rule.equations} | {_cells(one)} | {one.where} |"
    yield ""


def _constants_table(effects: Mapping[str, Effect]) -> Iterator[str]:
    """Yield the effect of each constant, halved and doubled, and those that move nothing."""
    yield "## Constants"
    yield ""
    yield (
        "| constant | default | unit | from | total ½ | total 2 | tilt ½ | tilt 2 | objective ½ | "
        "objective 2 | worst ½ | worst 2 |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|"
    still = []
    for name, row in CONSTANTS.items():
        both = [effects.get(f"{name} × {factor:g}") for factor in (0.5, 2.0)]
        if all(one is None for one in both):
            continue
        pairs = [
            *([f"{one.total:+.1f}" if one else "" for one in both]),
            *([f"{one.tilt:+.1f}" if one else "" for one in both]),
            *([f"{one.score:+.3f}" if one else "" for one in both]),
            *([f"{one.worst:+.1f}" if one else "" for one in both]),
        ]
        yield f"| `{name}` | {row.default:g} | {row.unit} | {row.origin} | {' | '.join(pairs)} |"
        if all(one is not None and not one.moves for one in both):
            still.append(f"`{name}`")
    yield ""
    yield f"Move nothing here by {NOTHING_PERCENT} % either way: {', '.join(still) or 'none'}."
    yield ""
    yield (
        "These constants are for cases that the recordings do not contain. Such are wrong rigs, joints "
        "that fit nowhere, segments without module, cells that see the sun, and sensors at the end of "
        "their range. Others are modules that are silent for seconds, runners, receivers of satellites and "
        "beacons, a body near a magnetic pole, and a heading that was shown wrongly. Tests of their own "
        "cover each case."
    )


def _cells(one: Effect) -> str:
    return f"{one.total:+.1f} | {one.tilt:+.1f} | {one.score:+.3f} | {one.worst:+.1f}"


def main(words: Sequence[str] | None = None) -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sensitivity",
        description="Halve and double every constant of the estimator, and switch its rules of thumb off.",
        epilog="example: python -m benchmarks.sensitivity --only huber learn_s",
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these constants and rules")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}, run nothing")
    parser.add_argument("--patched", nargs="+", metavar="NAME", help=argparse.SUPPRESS)
    asked = parser.parse_args(words)
    if asked.patched:
        patched(asked.patched[0], asked.patched[1:])
        return
    if not asked.write:
        unknown = set(asked.only or ()) - set(CONSTANTS) - set(RULES)
        if unknown:
            parser.error(f"neither constants nor rules: {', '.join(sorted(unknown))}")
        only = set(asked.only or ())
        chosen = [
            one
            for one in tries()
            if not only
            or one.name == DEFAULT
            or one.rule in only
            or (set(one.changes) & only and not one.rule)
        ]
        run(chosen, recordings())
        return
    PAGE.write_text("\n".join(page()) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
