"""``video``: heat maps to skeleton, on known truth and on four cameras' pictures of one walker.

The pictures' reference is another markerless result: it measures agreement, never accuracy.
"""

from __future__ import annotations

from benchmarks.figures import Figure, Report, table
from benchmarks.video_peer import filtered, triangulated
from benchmarks.video_pictures import DATA, RATE_HZ, Seen, look, off_in_pictures, points_2d, solve
from benchmarks.video_scoring import (
    LIMBS,
    agreement,
    by_joint,
    jitter_mm,
    length_spread_mm,
    limbs_of,
    reference_limbs,
)
from benchmarks.video_truth_rows import truth_rows
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.reconstruction.video.low_pass import DELAY

NETWORKS = ("full", "heavy")
"""The first one is aimed at."""
PICTURES = 100
CORES = 2
_BY_JOINT = ["joint", "mean", "of it in all frames", "varying, RMS"]
_HEADS = [
    "points", "mean", "median", "p95", "aligned, trial", "aligned, frame", "jitter", "bone length spread",
]  # fmt: skip


def run() -> Report:
    """Known truth first, then the pictures, with the networks whose weights are there."""
    report = Report("video")
    figures, rows = truth_rows()
    report.figures += figures
    report.tables.append("## Known truth: joints of rendered people, errors in mm\n\n" + table(*rows))
    if not DATA.is_dir():
        print(f"{DATA.name} is not there: known truth only")
        return report
    for network in NETWORKS:
        try:
            seen = look(network)
        except GatewayError as error:
            print(f"{network}: {error}")
            continue
        rows_of = _points(seen)
        report.tables.append(
            f"## `pose2sim_single`, BlazePose {network}: 12 limb joints against the reference, mm\n\n"
            + table(_HEADS, [[name, *_row(limbs)] for name, limbs in rows_of.items()])
        )
        report.figures += _timing(network, seen)
        if network == NETWORKS[0]:
            report.figures += [*_figures(rows_of), _in_step(seen)]
            smoothed = list(rows_of.values())[2]
            report.tables.append(
                f"## The same by joint, smoothed, mm\n\n{table(_BY_JOINT, by_joint(smoothed, _reference()))}"
            )
    return report


def _points(seen: Seen) -> dict[str, FloatArray]:
    """(F, 12, 3) m, by what they are."""
    names = seen.person.names
    solved = solve(seen)
    pixels, likelihood = points_2d(seen)
    rows = [names.index(name) for name in LIMBS]
    peer, places = triangulated(seen.cameras, pixels[:, :, rows], likelihood[:, :, rows])
    body = {
        "candidates of the lattice": solved.candidates,
        "body, weighted by PCM": solved.body,
        "body, weighted by PCM, smoothed": solved.smoothed,
    }
    return {name: limbs_of(each, names) for name, each in body.items()} | {
        peer: places,
        f"{peer}, filtered": filtered(places, RATE_HZ),
        "reference before its filter": _reference("ref_0-100.trc"),
    }


def _row(limbs: FloatArray) -> list[str]:
    with_reference = agreement(limbs, _reference())
    values = [
        with_reference.mean, with_reference.median, with_reference.p95, with_reference.aligned_trial,
        with_reference.aligned_frames, jitter_mm(limbs), length_spread_mm(limbs),
    ]  # fmt: skip
    return [f"{value:.1f}" for value in values]


def _reference(name: str = "ref_0-100_filt_butterworth.trc") -> FloatArray:
    return reference_limbs(DATA / "reference" / name, PICTURES)


def _figures(points: dict[str, FloatArray]) -> list[Figure]:
    body, smoothed, peer = (list(points.values())[k] for k in (1, 2, 3))
    ours, theirs = agreement(smoothed, _reference()), agreement(peer, _reference())
    what = "12 limb joints, 4 cameras, BlazePose full, smoothed; agreement with another markerless result"
    return [
        Figure("pictures_mean_mm", ours.mean, "mm", "<=40", what),
        Figure("pictures_p95_mm", ours.p95, "mm", note="the same, 95 in 100 are nearer"),
        Figure("pictures_aligned_mm", ours.aligned_frames, "mm", "<=30", "the same, every frame aligned"),
        Figure(
            "pictures_mean_over_peer", ours.mean / theirs.mean, "", "<1.0",
            f"over {list(points)[3]} of the same heat maps' centroids",
        ),
        Figure(
            "pictures_aligned_over_peer", ours.aligned_frames / theirs.aligned_frames, "", "<1.0",
            "the same, every frame aligned",
        ),
        Figure("pictures_jitter_before_mm", jitter_mm(body), "mm", note="mean second difference, 60 Hz"),
        Figure("pictures_jitter_after_mm", jitter_mm(smoothed), "mm", note="smoothed"),
        Figure("pictures_delay_ms", 1e3 * DELAY / RATE_HZ, "ms", note="of the smoothing, at 60 Hz"),
        Figure(
            "pictures_bone_spread_mm", length_spread_mm(smoothed), "mm", "<=0.1",
            "largest standard deviation of a bone's length",
        ),
    ]  # fmt: skip


def _in_step(seen: Seen) -> Figure:
    rows = [seen.person.names.index(name) for name in LIMBS]
    return Figure(
        "pictures_off_in_time", abs(off_in_pictures(seen, rows, _reference())), "pictures", "<=0",
        "by which 2D points and the reference, by its own times, match best: no part of the disagreement",
    )  # fmt: skip


def _timing(network: str, seen: Seen) -> list[Figure]:
    rate = CORES * 1e3 / (seen.network_ms + seen.reconstructor_ms)
    return [
        Figure(
            f"{network}_network_ms", seen.network_ms, "ms", note="processor time a frame, 4 crops and maps"
        ),
        Figure(
            f"{network}_reconstructor_ms", seen.reconstructor_ms, "ms",
            note="processor time a frame: lattices, inverse kinematics, smoothing, next crops",
        ),
        Figure(
            f"{network}_frames_per_s", rate, "1/s", ">=15" if network == NETWORKS[0] else "",
            f"4 cameras, {CORES} cores kept busy, decoding not counted",
        ),
    ]  # fmt: skip
