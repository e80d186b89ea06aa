"""``joint`` beside VQF on chains drawn at random, new for every seed.

How starts in motion and coarse devices are taken, and when a field is taken for the earth's, was found on
chains of this kind, of other seeds; no other setting was chosen on any. In all of them the rig has the field
of the place right, but for iron. ``CHAINS_SEED=N`` draws others, ``CHAINS=N`` more or fewer.
"""

from __future__ import annotations

import os

import numpy as np

from benchmarks.figures import Figure, Report, table
from gateway.emulation.fast_arm import sampled
from gateway.emulation.random_chains import HEADS, HELD_BY, RandomChain, drawn
from gateway.emulation.recordings import SMOOTHED, solved
from gateway.emulation.simulation import errors_deg
from gateway.frames import ImuFrame

PEER, OURS = "independent", "joint"
CHAINS = 60
FIRST_SEED = 5000
SCORED_AFTER_S = 4.0
MOST_OF = {"fixed point": ("<=0.7", "<=1.1"), "position device": ("<=0.7", "<=1.1"), "nothing": ("<=1.0", "")}
"""What held chains and unaided ones are to reach: the mean ratio to VQF, and the worst."""


def run() -> Report:
    """Every chain by all methods."""
    report = Report("chains")
    first = int(os.environ.get("CHAINS_SEED", FIRST_SEED))
    count = int(os.environ.get("CHAINS", CHAINS))
    rows: list[list[str]] = []
    ratios: dict[str, list[float]] = {held_by: [] for held_by in HELD_BY}
    smoothed: list[float] = []
    for seed in range(first, first + count):
        chain = drawn(seed)
        peer, ours, both_ways = errors(chain)
        ratios[chain.held_by].append(ours / peer)
        smoothed.append(both_ways / ours)
        cells = (f"{value:.2f}" for value in (peer, ours, ours / peer, both_ways))
        rows.append([*chain.described(), *cells])
        print(f"chains: {' | '.join(rows[-1])}", flush=True)
    for held_by, found in ratios.items():
        if found:
            report.figures += _figures(held_by, found)
    note = "`joint` smoothed over `joint` as it runs live, mean of the ratios"
    report.figures.append(Figure("smoothed_chains_mean_ratio", float(np.mean(smoothed)), "", "<1.0", note))
    report.tables.append(
        "## Chains drawn at random: RMSE, degrees, mean of the segments\n\n"
        f"Orientation against the world, nothing aligned or taken out, from {SCORED_AFTER_S:g} s on; 30 s "
        "each. Parents: of the second segment and those that follow. rad/s: peak of any segment. Wrong "
        "beside noise, biases and scales: lever arms, and what is named; position devices sit up to some "
        "centimetres beside where the rig has them.\n\n"
        + table([*HEADS, "VQF, °", "`joint`, °", "ratio", "smoothed, °"], rows)
    )
    return report


def errors(chain: RandomChain) -> tuple[float, float, float]:
    """Degrees: VQF's, ours, and ours forward and backward."""
    frames = sampled(chain.suit, chain.motion, chain.switches, chain.seed, chain.rate_hz)
    peer, ours, both_ways = (_error(method, chain, frames) for method in (PEER, OURS, SMOOTHED))
    return peer, ours, both_ways


def _error(method: str, chain: RandomChain, frames: list[ImuFrame]) -> float:
    poses = solved(method, chain.suit, 1.0 / chain.rate_hz, frames)
    return float(np.mean(errors_deg(poses, chain.motion, SCORED_AFTER_S)))


def _figures(held_by: str, found: list[float]) -> list[Figure]:
    mean, worst = MOST_OF[held_by]
    name = f"chains_{held_by.replace(' ', '_')}"
    note = f"`joint` over `independent` (VQF), {len(found)} random chains held by {held_by}"
    return [
        Figure(f"{name}_mean_ratio_vqf", float(np.mean(found)), "", mean, f"{note}: mean of the ratios"),
        Figure(f"{name}_worst_ratio_vqf", float(np.max(found)), "", worst, f"{note}: worst"),
    ]
