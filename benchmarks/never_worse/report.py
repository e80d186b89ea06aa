"""The table and the figures."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.figures import Figure, Report, table
from benchmarks.never_worse import peers
from benchmarks.never_worse.case import Variant
from benchmarks.never_worse.judged import LATER, SMOOTHED, VQFS, Judged
from benchmarks.never_worse.judging import Claims, Errors
from benchmarks.never_worse.objective import score
from benchmarks.never_worse.solving import OURS

_VARIANTS = [Variant(device, field) for device in (True, False) for field in (True, False)]
_OWN = ("joint", "outward", "independent")
_TARGETS = dict.fromkeys(("covered_percent", "in_ellipsoid_percent"), (">=93", "<=97"))
"""Of the least and of the most. The first is met by honest claims only where one axis is much less certain
than the others: of two or three alike, 98 or 99 % of errors are within 2 sigma."""


def report(found: list[Judged]) -> Report:
    """Return figures and tables of what has been judged."""
    result = Report("never_worse")
    for part, mean_target, worst_target in (("validation", "<=0.4", "<=1.0"), ("training", "", "")):
        chosen = [one for one in found if one.part == part]
        if chosen:
            result.figures += _ratios(part, chosen, mean_target, worst_target)
    result.figures += _field_and_start(found)
    result.figures += _honesty(found)
    notes = "; ".join(peers.skipped())
    versions = ", ".join(f"{name} {version}" for name, version in peers.versions().items())
    result.tables.append(
        "## Every recording: RMSE, degrees, total / tilt, mean of the segments\n\n"
        "One heading and one misalignment a segment are taken out. Errors count from 5 s after the beginning "
        "on, and from 3 s after the motion begins. VQF: the better of 6- and 9-axis; ½ later: its "
        "orientations taken half a sample later, since it runs half a sample ahead. Others: the best of "
        "imufusion, Madgwick, Mahony, EKF, qmt's joint constraints and offline VQF. `joint` live with what "
        "is "
        "named. Worst: the largest ratio of `joint` over the VQF that knows no more (6-axis alone where the "
        "field is not used). Smoothed: of the best informed. v: validation, t: training, see "
        f"`benchmarks/never_worse/split.yaml`. Peers: {versions}. Left out: {notes}.\n\n"
        + _by_recording(found)
    )
    result.tables.append(
        "## Honesty, by kind of recording\n\n"
        "Each live / smoothed. % in 2σ: errors within twice the root of the covariance's trace, which holds "
        "95 to 99 % of honest ones. % in ellipsoid: errors within the ellipsoid of the covariance that is to "
        "hold 95 % of them. NEES: normalised estimation error squared, 1 is honest, above claims too much; "
        "live by segment and by tenth of the time: least and most. Where truth and rig have the same world, "
        "nothing is taken out, and with the field all three components count; else the tilt's two, so that "
        "nobody's north hides a tilt. Where the "
        "mean specific force proves that a truth's vertical is off by more than 0.5°, as the T-stick's, that "
        "is set right. "
        "Heading: seconds from when the motion begins until every heading is within 5° for a second.\n\n"
        + _by_kind(found)
    )
    return result


def _ratios(part: str, found: list[Judged], mean_target: str, worst_target: str) -> Iterator[Figure]:
    flat = {one.name: (one.kind, {v: one.ratio(v) for v in one.variants}) for one in found}
    total = score(flat)
    (name, variant), worst = max(total.ratios.items(), key=lambda each: each[1])
    lost = sum(ratio > 1.0 for ratio in total.ratios.values())
    over = "`joint` live over the better of VQF 6- and 9-axis"
    yield Figure(f"{part}_worst_ratio_vqf", worst, "", worst_target, f"{over}: {name}, {variant}")
    note = f"{over}: geometric mean of {len(total.ratios)} ratios, kinds weighted alike"
    yield Figure(f"{part}_mean_ratio_vqf", total.mean_ratio, "", mean_target, note)
    yield Figure(
        f"{part}_worse_than_vqf", lost, "", "", f"of {len(total.ratios)} ratios of {len(found)} recordings"
    )
    yield Figure(
        f"{part}_objective", total.value, "", "", "mean ratio and the mean of what ratios exceed 1 by"
    )
    tilts = [one.errors[v][OURS].tilt / one.vqf(v, LATER, "tilt") for one in found for v in one.variants]
    note = "tilt of `joint` live over VQF's, taken half a sample later: geometric mean and worst"
    yield Figure(f"{part}_mean_tilt_ratio_vqf_half_later", float(np.exp(np.log(tilts).mean())), "", "", note)
    yield Figure(f"{part}_worst_tilt_ratio_vqf_half_later", max(tilts), "", "", note)
    both = [
        one.ratio(v, OURS + SMOOTHED)
        for one in found
        for v in one.variants
        if OURS + SMOOTHED in one.errors[v]
    ]
    if both:
        yield Figure(f"{part}_smoothed_worst_ratio_vqf", max(both), "", "", "`joint` smoothed over VQF live")


def _field_and_start(found: list[Judged]) -> Iterator[Figure]:
    ratios = [
        (one.field_ratio(), one.name) for one in found if one.is_spatial and np.isfinite(one.field_ratio())
    ]
    if ratios:
        worst, name = max(ratios)
        note = f"`joint` live with the field over without it, recordings with 3-D motion: {name}"
        yield Figure("field_worst_ratio", worst, "", "<=1.1", note)
    starts = [
        (one.errors[v][OURS].heading_start_s, one.name, str(v))
        for one in found
        for v in one.variants
        if np.isfinite(one.errors[v][OURS].heading_start_s)
    ]
    if starts:
        longest, name, variant = max(starts)
        note = f"until every heading is within 5°, from when the motion begins: {name}, {variant}"
        yield Figure("heading_start_s", longest, "s", "<=3", note)


def _honesty(found: list[Judged]) -> Iterator[Figure]:
    kinds = _kinds(found)
    sets: dict[str, dict[str, float]] = {"covered_percent": {}, "in_ellipsoid_percent": {}, "nees": {}}
    for kind, ones in kinds.items():
        for method in (OURS, OURS + SMOOTHED):
            claims = _claims(ones, method)
            for name, values in sets.items():
                each = [getattr(claim, name) for claim in claims if np.isfinite(getattr(claim, name))]
                if each:
                    values[f"{kind}, {'smoothed' if method != OURS else 'live'}"] = float(np.mean(each))
    for prefix, name, unit, note in (  # least and most of a kind
        ("sigma_coverage_percent", "covered_percent", "%", "errors of `joint` within 2 sigma"),
        ("ellipsoid_coverage_percent", "in_ellipsoid_percent", "%", "errors within the ellipsoid for 95 %"),
        ("nees", "nees", "", "normalised estimation error squared, 1 is honest"),
    ):  # fmt: skip
        if values := sets[name]:
            low, high = min(values, key=values.__getitem__), max(values, key=values.__getitem__)
            targets = _TARGETS.get(name, ("", ""))
            yield Figure(f"{prefix}_low", values[low], unit, targets[0], f"{note}: {low}")
            yield Figure(f"{prefix}_high", values[high], unit, targets[1], f"{note}: {high}")


def _kinds(found: list[Judged]) -> dict[str, list[Judged]]:
    kinds: dict[str, list[Judged]] = {}
    for one in found:
        kinds.setdefault(one.kind, []).append(one)
    return kinds


def _claims(found: list[Judged], method: str) -> list[Claims]:
    return [one.claims[v][method] for one in found for v in one.variants if method in one.claims[v]]


def _by_recording(found: list[Judged]) -> str:
    rows = []
    for one in found:
        best = one.variants[0]
        errors = one.errors[best]
        others = {
            n: e for n, e in errors.items() if n.removesuffix(LATER) not in VQFS and not n.startswith(_OWN)
        }
        other = min(others, key=lambda name: others[name].total, default="")
        vqf, later = (
            min((errors[n + w] for n in VQFS if n + w in errors), key=lambda e: e.total) for w in ("", LATER)
        )
        ratio, variant = one.worst
        cells = [_cell(one.errors[v][OURS]) if v in one.errors else "–" for v in _VARIANTS]
        smoothed = _cell(errors[OURS + SMOOTHED]) if OURS + SMOOTHED in errors else "–"
        named = f"{_cell(others[other])} {other}" if other else "–"
        rows.append(
            [
                one.name,
                one.part[0],
                _cell(vqf),
                _cell(later),
                named,
                *cells,
                smoothed,
                f"{ratio:.2f} {variant}",
            ]
        )
    heads = ["recording", "", "VQF", "½ later", "others", *map(str, _VARIANTS), "smoothed", "worst"]
    return table(heads, rows)


def _cell(errors: Errors) -> str:
    return f"{errors.total:.2f} / {errors.tilt:.2f}"


def _by_kind(found: list[Judged]) -> str:
    rows = []
    for kind, ones in _kinds(found).items():
        live = _claims(ones, OURS)
        both = live, _claims(ones, OURS + SMOOTHED)
        starts = [one.errors[v][OURS].heading_start_s for one in ones for v in one.variants]
        rows.append(
            [
                kind,
                " / ".join(_mean([c.covered_percent for c in each]) for each in both),
                " / ".join(_mean([c.in_ellipsoid_percent for c in each]) for each in both),
                " / ".join(_mean([c.nees for c in each], 2) for each in both),
                _span([n for c in live for n in c.nees_by_segment]),
                _span([n for c in live for n in c.nees_by_time]),
                _extreme(starts, np.nanmedian),
                _extreme(starts, np.nanmax),
            ]
        )
    heads = ["kind", "% in 2σ", "% in ellipsoid", "NEES", "by segment", "by time"]
    return table([*heads, "heading, s: median", "worst"], rows)


def _mean(values: list[float], digits: int = 0) -> str:
    return _extreme(values, np.nanmean, digits)


def _extreme(values: list[float], of: Callable[[list[float]], float], digits: int = 1) -> str:
    return f"{of(values):.{digits}f}" if np.isfinite(values).any() else "–"


def _span(values: list[float]) -> str:
    return f"{np.nanmin(values):.2f} – {np.nanmax(values):.2f}" if np.isfinite(values).any() else "–"


def write_table(found: list[Judged], path: Path) -> None:
    """Write every error of every method, one a row, as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = ["total", "tilt", "raw_total", "raw_tilt", "relative", "heading_start_s"]
        writer.writerow(
            ["recording", "part", "kind", "device", "field", "method", "ratio_vqf", *names, "by_segment"]
        )
        for one in found:
            for v in one.variants:
                for method, errors in one.errors[v].items():
                    values = [f"{getattr(errors, name):.4f}" for name in names]
                    segments = " ".join(f"{each:.3f}" for each in errors.by_segment)
                    given = [one.name, one.part, one.kind, int(v.has_device), int(v.has_field), method]
                    writer.writerow([*given, f"{one.ratio(v, method):.4f}", *values, segments])
