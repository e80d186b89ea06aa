"""Floor forces that nobody measured: what would explain the motion, shared among points of the soles.

At each instant the force and moment that the whole body takes (its momentum's change against gravity) are
laid out over the soles' points by non-negative least squares along the edges of each point's friction
pyramid. A point is the dearer to load the higher it is and the faster it moves. In a step's double support
the motion alone tells the feet apart badly (a few newtons at the height of the hips are centimetres at the
floor): there the load is asked to go over smoothly from the foot that leaves to the one that has landed
(after Ren et al. 2008, J. Biomech. 41(12): 2750–2759). What no allowed force explains stays as the residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from devices.deferred import expit, nnls
from gateway.analysis.floor import (
    LEAST_FORCE_N,
    FloorForces,
    ForceSource,
    floor_height,
    sole_paths,
    sole_points,
)
from gateway.analysis.inverse_dynamics import Dynamics, Progress
from gateway.analysis.smooth_motion import SmoothMotion
from gateway.frames import FloatArray, IntArray

_FRAMES_A_REPORT = 64
_STANDS = 0.5
"""From this sureness of one of its points on a foot stands."""
_MOST_STEPS = 4000
"""Of the active-set method; it usually takes as many as there are loaded edges."""


@dataclass(frozen=True)
class ContactSettings:
    """How the floor is told from the motion."""

    friction: float = 0.8
    """Coefficient, shoe or skin on a laboratory's floor."""
    height_m: float = 0.030
    """Above the floor, at which a point is half as likely to carry."""
    height_spread_m: float = 0.008
    speed_m_s: float = 1.0
    """At which a point is half as likely to carry."""
    speed_spread_m_s: float = 0.15
    arm_m: float = 1.0
    """A moment counts as much as a force at this arm."""
    cost: float = 1e-3
    """Of the squared load of a point that stands, against the squared force left over."""
    split: float = 10.0
    """Of the squared distance from the smooth split in double support, as ``cost``."""
    longest_transfer_s: float = 0.5
    """A double support that lasts longer is standing: no split is asked for."""
    least_share: float = 3e-3
    """Of a point that surely does not stand: its load is 1/share² as dear."""


def estimated_floor(
    motion: SmoothMotion,
    free: Dynamics,
    known: FloorForces | None = None,
    settings: ContactSettings | None = None,
    progress: Progress | None = None,
    instants: range | None = None,
) -> FloorForces:
    """Return forces of feet for which none is known. free: the dynamics without any floor.

    known: measured forces; where a foot's is ``MEASURED`` it stays, and only the rest is shared out.
    instants: frames that are wanted, nothing is estimated at others; None: all.
    """
    chosen = settings or ContactSettings()
    carriers, points = sole_points(motion.skeleton)
    segments = np.unique(carriers)
    paths = sole_paths(carriers, points, free.p_w, free.rotation_wb)
    height = floor_height(paths)
    root = int(np.flatnonzero(motion.skeleton.parents < 0)[0])
    taken = np.concatenate([free.residual_force, free.residual_moment], axis=1)
    standing = stances(motion.time_s, paths, height, chosen)
    places = np.searchsorted(segments, carriers)
    shares = smooth_split(motion.time_s, standing, places, chosen)
    frames = len(paths)
    force, moment = np.zeros((2, frames, len(segments), 3))
    source = np.full((frames, len(segments)), ForceSource.NONE, dtype=np.uint8)
    if known is not None:
        _enter_known(known, segments.tolist(), force, moment, source)
    for f in range(frames) if instants is None else instants:
        origin = free.p_w[f, root]
        wanted = taken[f].copy()
        wanted[:3] -= force[f].sum(axis=0)
        wanted[3:] -= (moment[f] - np.cross(origin, force[f])).sum(axis=0)
        is_free = (source[f] != ForceSource.MEASURED)[places]
        if is_free.any():
            share = shares[f] if is_free.all() else np.full(len(segments), np.nan)
            loads = _shared(
                wanted, paths[f, is_free] - origin, standing[f, is_free], places[is_free], share, chosen
            )
            for at, load, c in zip(paths[f, is_free], loads, places[is_free].tolist(), strict=True):
                force[f, c] += load
                moment[f, c] += np.cross(at, load)
        loaded = (force[f, :, 2] > LEAST_FORCE_N) & (source[f] == ForceSource.NONE)
        source[f, loaded] = ForceSource.ESTIMATED
        if progress is not None and f % _FRAMES_A_REPORT == 0:
            progress(f, frames)
    shown = np.full(source.shape, height) if known is None else known.height_m
    return FloorForces(segments, force, moment, source, shown, () if known is None else known.notes)


def stances(time_s: FloatArray, paths: FloatArray, height_m: float, settings: ContactSettings) -> FloatArray:
    """Return (F, P) from 0 to 1: how surely points with these paths (F, P, 3) carry."""
    speed = np.linalg.norm(np.gradient(paths, time_s, axis=0), axis=-1)
    above = paths[..., 2] - height_m
    low = expit((settings.height_m - above) / settings.height_spread_m)
    slow = expit((settings.speed_m_s - speed) / settings.speed_spread_m_s)
    sure: FloatArray = np.maximum(low * slow, settings.least_share)
    return sure


def with_unknown(motion: SmoothMotion, free: Dynamics, floor: FloorForces) -> FloorForces:
    """Return the same, told where a foot stands whose force nothing tells. free: the dynamics without any
    floor."""
    carriers, points = sole_points(motion.skeleton)
    if not len(carriers) or not len(floor.segments):
        return floor
    paths = sole_paths(carriers, points, free.p_w, free.rotation_wb)
    sure = stances(motion.time_s, paths, floor_height(paths), ContactSettings())
    stands = np.stack([(sure[:, carriers == s] > _STANDS).any(axis=1) for s in floor.segments], axis=1)
    unknown = stands & (floor.source == ForceSource.NONE)
    return replace(floor, source=np.where(unknown, np.uint8(ForceSource.UNKNOWN), floor.source))


def smooth_split(
    time_s: FloatArray, standing: FloatArray, places: IntArray, settings: ContactSettings
) -> FloatArray:
    """Return (F, C) share of each of two feet in the load while one stands alone, or takes over from the
    other; NaN elsewhere: in standing on both, in flight, and for other bodies.

    standing: (F, P). places: (P,) which foot each point belongs to.
    """
    count = int(places.max()) + 1 if len(places) else 0
    shares = np.full((len(time_s), count), np.nan)
    if count != 2:
        return shares
    stands = np.stack([standing[:, places == c].max(axis=1) > _STANDS for c in range(count)], axis=1)
    for c in range(count):
        shares[stands[:, c] & ~stands[:, 1 - c]] = np.eye(count)[c]
    both = np.concatenate([[False], stands.all(axis=1), [False]]).astype(np.int8)
    begins, ends = np.flatnonzero(np.diff(both) == 1), np.flatnonzero(np.diff(both) == -1)
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        if begin == 0 or end == len(time_s) or time_s[end] - time_s[begin] > settings.longest_transfer_s:
            continue
        old, new = int(np.argmax(stands[begin - 1])), int(np.argmax(stands[end]))
        if old != new and stands[begin - 1].any() and stands[end].any():
            done = (time_s[begin:end] - time_s[begin - 1]) / (time_s[end] - time_s[begin - 1])
            shares[begin:end, new] = done * done * (3.0 - 2.0 * done)
            shares[begin:end, old] = 1.0 - shares[begin:end, new]
    return shares


def _shared(
    wanted: FloatArray,
    arms: FloatArray,
    standing: FloatArray,
    places: IntArray,
    share: FloatArray,
    settings: ContactSettings,
) -> FloatArray:
    """Return (P, 3) N on points at arms (P, 3) from the root, that make a force and moment (6,) as well as
    they may.

    places: (P,) the foot of each point. share: (C,) of the load that each foot is to have; NaN: as it comes.
    """
    edges = settings.friction * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]) + [0, 0, 1]
    forces = np.tile(edges, (len(arms), 1))  # (4 P, 3)
    moments = np.cross(np.repeat(arms, len(edges), axis=0), forces) / settings.arm_m
    dear = np.sqrt(settings.cost) / np.repeat(standing, len(edges))
    asked = np.flatnonzero(np.isfinite(share))
    on_foot = np.sqrt(settings.split) * (np.repeat(places, len(edges)) == asked[:, None])
    rows = np.vstack([forces.T, moments.T, on_foot, np.diag(dear)])
    loads = np.sqrt(settings.split) * share[asked] * max(wanted[2], 0.0)
    target = np.concatenate([wanted[:3], wanted[3:] / settings.arm_m, loads, np.zeros(len(dear))])
    size = np.linalg.norm(rows, axis=0)
    scaled, _ = nnls(rows / size, target, maxiter=_MOST_STEPS)
    along = scaled / size
    shared: FloatArray = (along[:, None] * forces).reshape(len(arms), len(edges), 3).sum(axis=1)
    return shared


def _enter_known(
    known: FloorForces, segments: list[int], force: FloatArray, moment: FloatArray, source: NDArray[np.uint8]
) -> None:  # fmt: skip
    """Enter measured forces into arrays by ``segments``, in place."""
    for k, segment in enumerate(known.segments.tolist()):
        c = segments.index(segment)
        measured = known.source[:, k] == ForceSource.MEASURED
        force[measured, c] = known.force[measured, k]
        moment[measured, c] = known.moment[measured, k]
        source[measured, c] = ForceSource.MEASURED
