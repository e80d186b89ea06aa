"""Suite ``body_faults``: what befalls the body's sensors, and what `joint` makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.figures import Figure, Report, table
from gateway.body.skeleton import WornSuit
from gateway.emulation.body_faults import (
    BEGIN_S,
    LONG_SECONDS,
    ML_CASES,
    MODULE_CASES,
    RECOVERED_DEG,
    VICTIM,
    VICTIM_SEGMENT,
    Case,
    Run,
    doubtful_after_s,
    emulated,
    fault_effect,
    is_finite,
    largest_step_deg,
    reported_after_s,
    suit_with_position,
)
from gateway.frames import Status


def run() -> Report:
    """All cases, as a table and figures."""
    report = Report("body_faults")
    suit = suit_with_position()
    calm = emulated(suit, Case("nothing", lasts_s=0.0, seconds=LONG_SECONDS))
    _module_table(report, suit, calm)
    _worn_table(report, suit)
    _ml_table(report, suit, calm)
    return report


def _others(suit: WornSuit, victims: list[int]) -> tuple[list[int], list[int]]:
    """The segments that have a joint with one of the victims, and those that have none."""
    parents = suit.skeleton.parents
    near = {int(parents[s]) for s in victims} | set(np.flatnonzero(np.isin(parents, victims)).tolist())
    near -= {-1, *victims}
    return sorted(near), [s for s in range(len(parents)) if s not in near and s not in victims]


WALKS = 4
"""Each with noise and a walk of its own."""
WORN_S = 16.0


def _worn_table(report: Report, suit: WornSuit) -> None:
    """How soon it is told that modules are worn wrong, and whether others are suspected."""
    calm = Case("as the rig says", lasts_s=0.0, seconds=WORN_S)
    cases = (calm, *(replace(case, seconds=WORN_S) for case in MODULE_CASES if case.worn))
    rows, slowest_s, others = [], {}, 0
    for case in cases:
        runs = [emulated(suit, case, seed=seed) for seed in range(1, WALKS + 1)]
        wrong = [suit.skeleton.index(name) for name in case.worn_wrong]
        reported_s = [doubtful_after_s(run, wrong) for run in runs] if wrong else []
        ever = [np.flatnonzero((run.status == Status.DOUBTFUL).any(axis=0)) for run in runs]
        suspected = sum(len(set(segments.tolist()) - set(wrong)) for segments in ever)
        others += suspected
        slowest_s[case.worn] = max(reported_s, default=0.0) if not np.isnan(reported_s).any() else np.nan
        agreement = [run.agreement.get(VICTIM_SEGMENT, np.nan) for run in runs]
        why = next((run.doubts[VICTIM] for run in runs if VICTIM in run.doubts), "–")
        cells = [
            ", ".join(map(_seconds, reported_s)) or "–",
            str(suspected),
            f"{np.mean(agreement):.2f}",
            why,
        ]
        rows.append([case.name, *cells])
    head = ["case", "doubtful after, s of walking", "others suspected", "joint agreement", "reason given"]
    report.tables.append(
        f"## Modules worn wrong: how soon it is told, in {WALKS} walks of {WORN_S:g} s\n\n"
        "Why, and what is unseen: [walking](../explanation/walking.md#modules-worn-wrong-stuck-modules).\n\n"
        f"{table(head, rows)}"
    )
    for worn in ("upside_down", "swapped", "swapped_shanks"):
        note = f"slowest of {WALKS} walks, from setting off until all that are worn wrong are doubtful"
        report.figures.append(Figure(f"worn_{worn}_reported_s", slowest_s[worn], "s", "<=10", note))
    note = "segments worn as the rig says that were ever doubtful, all walks"
    report.figures.append(Figure("worn_others_suspected", others, "", "<=0", note))


def _module_table(report: Report, suit: WornSuit, calm: Run) -> None:
    rows, finite, worst_others = [], True, 0.0
    for case in MODULE_CASES:
        found = emulated(suit, case)
        finite &= is_finite(found)
        victims = [suit.skeleton.index(name) for name in case.worn_wrong or (VICTIM_SEGMENT,)]
        groups = (victims, *_others(suit, victims))
        own, near, far = (fault_effect(found, calm, segments) for segments in groups)
        worst_others = max(worst_others, far.worst_deg)
        agreement = _seconds(found.agreement.get(VICTIM_SEGMENT, np.nan))
        cells = [_seconds(reported_after_s(found, victims)), agreement]
        for one in (own, near, far):
            cells += [f"{one.worst_deg:.1f}", _seconds(one.recovery_s)]
        rows.append([case.name, *cells])
    head = ["case", "status tells after, s", "joint agreement", "own worst, °", "over after, s"]
    head += ["neighbours' worst, °", "over after, s", "others' worst, °", "over after, s"]
    report.tables.append(
        f"## A module fails: `joint` on the 7-module suit, walking; the module of the {VICTIM_SEGMENT}\n\n"
        "Excess over the run without fault. *Own*: of all whose module is faulty or worn wrong. "
        "*Joint agreement* (in `bridge/health`): 0 agrees with its neighbours, 1 has nothing to do with "
        f"them; without fault {calm.agreement.get(VICTIM_SEGMENT, np.nan):.2f}. "
        "*Over after*: from the end of the fault until the excess stays "
        f"below {RECOVERED_DEG:g}°; –: the fault lasts.\n\n" + table(head, rows)
    )
    report.figures.append(
        Figure("module_faults_finite", float(finite), "", ">=1", "every orientation and sigma is a number")
    )
    note = "largest excess of segments that are no neighbours of the faulty ones, any module fault"
    report.figures.append(Figure("module_faults_others_deg", worst_others, "°", "", note))


def _ml_table(report: Report, suit: WornSuit, calm: Run) -> None:
    rows, finite, worst_step = [], True, 0.0
    everyone = list(range(suit.skeleton.n_segments))
    calm_step = largest_step_deg(calm, BEGIN_S, LONG_SECONDS)
    for case in ML_CASES:
        found = emulated(suit, case)
        finite &= is_finite(found)
        end_s = case.ends_s
        whole, before = fault_effect(found, calm, everyone), _mean_sigma(found, BEGIN_S - 1.0, BEGIN_S)
        step = largest_step_deg(found, end_s, end_s + 5.0)
        worst_step = max(worst_step, step)
        rows.append([
            case.name, _seconds(reported_after_s(found, everyone)), f"{before:.1f}",
            f"{_mean_sigma(found, end_s - 0.3, end_s):.1f}",
            f"{whole.worst_deg:.1f}", _seconds(whole.recovery_s),
            f"{step:.2f}", f"{_place_off(found, end_s - 0.05):.2f}", f"{_place_step(found, end_s):.3f}",
            _seconds(_measured_again_s(found, end_s)),
        ])  # fmt: skip
    head = ["case", "status tells after, s", "mean sigma before, °", "at the end, °", "worst excess, °"]
    head += ["over after, s", "largest step after, °", "place off at the end, m", "step of place, m"]
    report.tables.append(
        "## The local device falls silent: the same, position of the pelvis at 100 Hz\n\n"
        "*Largest step after*: of any segment's tilt error from one frame to the next within 5 s after its "
        f"return; without fault {calm_step:.2f}°. The place stands still meanwhile and glides back.\n\n"
        + table([*head, "`measured` again after, s"], rows)
    )
    report.figures.append(Figure("ml_loss_finite", float(finite), "", ">=1", "as above, local device silent"))
    note = "largest step of any segment's tilt error when the local device returns; no visible jump"
    report.figures.append(Figure("ml_return_step_deg", worst_step, "°", "<0.5", note))


def _seconds(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.2f}"


def _mean_sigma(run: Run, from_s: float, to_s: float) -> float:
    now = (run.times_s >= from_s) & (run.times_s < to_s)
    return float(run.sigma_deg[now].mean())


def _place_off(run: Run, at_s: float) -> float:
    k = int(np.searchsorted(run.times_s, at_s))
    return float(np.linalg.norm(run.p_w[k, 0] - run.true_p_w[k, 0]))


def _place_step(run: Run, end_s: float) -> float:
    """Largest way of the pelvis between frames in the 5 s after the return, m."""
    now = (run.times_s >= end_s) & (run.times_s < end_s + 5.0)
    return float(np.linalg.norm(np.diff(run.p_w[now, 0], axis=0), axis=1).max())


def _measured_again_s(run: Run, end_s: float) -> float:
    is_unaided = (run.status == Status.UNAIDED).any(axis=1) & (run.times_s >= end_s)
    return float(run.times_s[is_unaided][-1] - end_s) if is_unaided.any() else 0.0
