"""Suite ``optical``: markers to skeleton, on simulated truth and on real trials, both methods."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.figures import Figure, Report, table
from benchmarks.optical_agreement import Agreement
from benchmarks.optical_gaps import HEADS, long_gaps, real_row
from benchmarks.optical_opensim import OpenSimBeside
from benchmarks.optical_simulation import simulated_rows
from devices.marker_files import MarkerTrial, read_markers
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.emulation.optical_truth import TRIALS, UNTOLD
from gateway.frames import FloatArray, MarkerFrame
from gateway.geometry import quaternion
from gateway.reconstruction.optical.fitting import FitOptions, fit_body, sighted
from gateway.reconstruction.optical.landmarks import measurements, to_world, vertical_axis
from gateway.reconstruction.optical.marker_set import MarkerSet, load_marker_set
from gateway.reconstruction.optical.pose_solver import BodyModel, body_model
from gateway.reconstruction.optical.published import Trial, solve_published
from gateway.reconstruction.optical.published_trial import published_trial
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.reconstruction.optical.rule_body import from_rules

DATA = Path(__file__).parents[2] / "shared" / "data"
PUBLISHED_FRAMES = 40
LEFT_OUT_FRAMES = 6
HELD_BY = 2
"""Other markers that a segment must carry for a marker left out of it to be foretold at all."""


@dataclass(frozen=True)
class Outcome:
    """Poses of held-out frames, and what they explain."""

    q_wb: FloatArray  # (F, S, 4)
    p_w: FloatArray  # (F, S, 3) m
    residuals: FloatArray  # (F, M) m
    left_out: FloatArray  # (M,) m RMSE, of each marker while the pose was not told it
    ms: float


def run() -> Report:
    """Known truth first, then three subjects."""
    report = Report("optical")
    figures, rows = simulated_rows()
    report.figures += [*figures, *long_gaps()]
    report.tables.append("## Simulated truth: RMSE of joint angles, degrees\n\n" + table(*rows))
    compared: list[list[str]] = []
    bridged: list[list[str]] = []
    agreement = Agreement()
    beside = OpenSimBeside()
    for name, (set_name, static, motion) in TRIALS.items():
        if not (DATA / motion).is_file():
            continue
        marker_set = load_marker_set(set_name)
        trials = [read_markers(DATA / static), read_markers(DATA / motion)]
        half = trials[1].n_frames // 2
        training = [trials[0], replace(trials[1], positions=trials[1].positions[:half])]
        held = replace(trials[1], positions=trials[1].positions[half:])
        lengths = UNTOLD.get(name, {})
        is_plug_in_gait = set_name == "plug_in_gait"
        if is_plug_in_gait:
            agreement.add_rules(name, marker_set, training, held, lengths)
        for method, solve in _methods(marker_set, training, lengths).items():
            skeleton, markers, outcome = solve(held)
            compared.append([name, method, *_explained(markers, outcome)])
            if method == "default":
                report.figures += [*_figures(name, outcome), _whole_command(name, skeleton, markers, held)]
                bridged.append(real_row(name, skeleton, markers, held))
                beside.add(name, skeleton, markers, held, outcome)
            if is_plug_in_gait:
                agreement.add(name, method, skeleton, outcome.q_wb, outcome.p_w, held)
    report.tables += [
        "## Held-out frames: distance of markers and body, RMSE in mm\n\n"
        "Left-out markers are not shown to the pose and looked for where the body, fitted with them to other "
        "frames, has them. *Held*: of segments that carry two others; *unheld*: of all others, where joints "
        "and what they are allowed must tell. *Published* is timed in one pass over the trial; the command "
        "makes up to eight.\n\n"
        + table(
            ["trial", "method", "held-out frames", "left out, held", "left out, unheld", "ms a frame"],
            compared,
        ),
        "## Held-out frames without two fifths of all points\n\n"
        "Every marker is missing for 40 % of the time, in gaps of 0.05 to 0.5 s; against the same frames "
        "with all of them, both by `--method both_ways`. Beside it the latter themselves, each joint by a "
        "spline through the instants at which two of the markers beyond it are seen, or its only one.\n\n"
        + table(HEADS, bridged),
        beside.text(),
        *agreement.tables(),
    ]
    return report


def _explained(markers: BodyMarkers, outcome: Outcome) -> list[str]:
    rmse = float(np.sqrt(np.nanmean(outcome.residuals**2)))
    own = np.bincount(markers.segments)[markers.segments]
    is_held = own > HELD_BY
    cells = [
        f"{1e3 * float(np.sqrt(np.nanmean(outcome.left_out[part] ** 2))):.1f}" for part in (is_held, ~is_held)
    ]
    return [f"{1e3 * rmse:.2f}", *cells, f"{outcome.ms:.2f}"]


def _figures(name: str, outcome: Outcome) -> list[Figure]:
    rmse = float(np.sqrt(np.nanmean(outcome.residuals**2)))
    return [
        Figure(f"{name}_held_out_rmse_mm", 1e3 * rmse, "mm", "<=6", "second half of the trial"),
        Figure(f"{name}_ms_per_frame", outcome.ms, "ms", "<=5", "processor time, streaming"),
    ]


def _whole_command(name: str, skeleton: Skeleton, markers: BodyMarkers, held: MarkerTrial) -> Figure:
    """Time a frame of the published method as the command goes about it, in passes over the whole trial."""
    observed = to_world(held.columns(markers.labels), markers.vertical)[:PUBLISHED_FRAMES]
    begun = time.process_time()
    solved = published_trial(skeleton, markers, observed, held.rate_hz)
    ms = 1e3 * (time.process_time() - begun) / len(observed)
    note = f"`optical solve --method published`, processor time, {solved.motion.passes} passes"
    return Figure(f"{name}_published_ms_per_frame", ms, "ms", note=note)


Solved = tuple[Skeleton, BodyMarkers, Outcome]


def _methods(
    marker_set: MarkerSet, training: list[MarkerTrial], lengths: Mapping[str, float]
) -> dict[str, Callable[[MarkerTrial], Solved]]:
    def streamed(centres: Literal["rules", "both"]) -> Callable[[MarkerTrial], Solved]:
        def solve(held: MarkerTrial) -> Solved:
            fitted = fit_body(marker_set, training, FitOptions(centres=centres, lengths=lengths))
            return fitted.skeleton, fitted.markers, _streamed(fitted.skeleton, fitted.markers, held)

        return solve

    return {
        "default": streamed("both"),
        "default, rules only": streamed("rules"),
        "published": lambda held: _published(marker_set, training, lengths, held),
    }


def _streamed(skeleton: Skeleton, markers: BodyMarkers, held: MarkerTrial) -> Outcome:
    observed = to_world(held.columns(markers.labels), markers.vertical)
    seen = _frames(observed, held.rate_hz)
    reconstructor = OpticalReconstructor(skeleton, markers)
    reconstructor.update(seen[0])
    reconstructor.reset()
    residuals, q_wb, p_w = [], [], []
    begun = time.process_time()
    for frame in seen:
        pose = reconstructor.update(frame)
        assert reconstructor.last is not None
        residuals.append(reconstructor.last.residuals)
        q_wb.append(pose.q_wb)
        p_w.append(pose.p_w)
    ms = 1e3 * (time.process_time() - begun) / len(seen)
    return Outcome(
        np.array(q_wb),
        np.array(p_w),
        np.array(residuals),
        _left_out(reconstructor, observed, held.rate_hz),
        ms,
    )


def _left_out(reconstructor: OpticalReconstructor, observed: FloatArray, rate_hz: float) -> FloatArray:
    """Each marker in turn is not shown, and looked for where the body has it; (M,) m RMSE."""
    part = _left_out_stretch(observed)
    found = np.empty(observed.shape[1])
    for m in range(observed.shape[1]):
        hidden = part.copy()
        hidden[:, m] = np.nan
        reconstructor.reset()
        squares = []
        for frame, true in zip(_frames(hidden, rate_hz), part[:, m], strict=True):
            reconstructor.update(frame)
            assert reconstructor.last is not None
            squares.append(((reconstructor.last.virtual[m] - true) ** 2).sum())
        found[m] = _root_mean(np.array(squares))
    return found


def _root_mean(squares: FloatArray) -> float:
    """NaN where none is known."""
    known = squares[np.isfinite(squares)]
    return float(np.sqrt(known.mean())) if len(known) else float("nan")


def _left_out_stretch(observed: FloatArray) -> FloatArray:
    return observed[: max(20, len(observed) // 4)]


def _frames(observed: FloatArray, rate_hz: float) -> list[MarkerFrame]:
    return [MarkerFrame(f, round(f * 1e9 / rate_hz), seen) for f, seen in enumerate(observed)]


def _published(
    marker_set: MarkerSet, training: list[MarkerTrial], lengths: Mapping[str, float], held: MarkerTrial
) -> Solved:
    """Body and virtual markers from a stretch of the first half, then the held-out frames with them."""
    measured = measurements(marker_set, training, lengths)
    vertical = vertical_axis(marker_set, training[0])
    sightings = [sighted(marker_set, trial, vertical, measured) for trial in training]
    skeleton, markers = from_rules(marker_set, sightings, vertical)
    columns = [marker_set.labels.index(label) for label in markers.labels]
    fitted = sightings[1] if np.isfinite(sightings[1].places.axes).all(axis=(1, 2, 3)).any() else sightings[0]
    good = np.flatnonzero(np.isfinite(fitted.places.axes).all(axis=(1, 2, 3)))[:PUBLISHED_FRAMES]
    seen = fitted.markers[good][:, columns]
    axes, root = fitted.places.axes[good], fitted.places.origins[good, 0]
    model = body_model(skeleton, markers)
    markers = replace(markers, positions=_first_frame_markers(model, seen[0], axes[0], root[0]))
    taught = solve_published(skeleton, markers, Trial(seen, held.rate_hz, axes, root))
    observed = to_world(held.columns(markers.labels), vertical)
    before = time.process_time()
    solved = published_trial(skeleton, taught.markers, observed, held.rate_hz, refine=False)
    ms = 1e3 * (time.process_time() - before) / len(observed)
    q_wb = np.array([[quaternion.from_matrix(each) for each in pose] for pose in solved.motion.R])
    left_out = _published_left_out(skeleton, taught.markers, observed, held.rate_hz)
    return skeleton, taught.markers, Outcome(q_wb, solved.p_w, solved.residuals, left_out, ms)


def _first_frame_markers(
    model: BodyModel, observed: FloatArray, R: FloatArray, root: FloatArray
) -> FloatArray:
    """(M, 3) m: markers of one frame in their segments; where one was not seen, as it was."""
    p = model.joints_at(R, root)
    local = np.einsum("mji,mj->mi", R[model.segments], observed - p[model.segments])
    places: FloatArray = np.where(np.isfinite(local), local, model.positions)
    return places


def _published_left_out(
    skeleton: Skeleton, markers: BodyMarkers, observed: FloatArray, rate_hz: float
) -> FloatArray:
    """As ``_left_out``, over the same stretch, at ``LEFT_OUT_FRAMES`` instants of it: the method is slow."""
    stretch = _left_out_stretch(observed)
    step = -(-len(stretch) // LEFT_OUT_FRAMES)
    part = stretch[::step]
    found = np.empty(observed.shape[1])
    for m in range(observed.shape[1]):
        hidden = part.copy()
        hidden[:, m] = np.nan
        solved = published_trial(skeleton, markers, hidden, rate_hz / step, refine=False)
        found[m] = _root_mean(((solved.virtual[:, m] - part[:, m]) ** 2).sum(axis=1))
    return found
