"""A motion as exported: regular in time, every segment defined, in the axes that the format wants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from devices.deferred import Rotation, Slerp
from gateway.body.joint_angles import joint_angles
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray, IntArray
from gateway.recording import Recording, SkeletonArrays
from gateway.recording.arrays import refuse_pauses
from gateway.recording.exporters.formats import Axes

_TURNS_DEG = {Axes.Z_UP: 0.0, Axes.Y_UP: -90.0}
"""About x."""


@dataclass(frozen=True)
class Take:
    """F frames of S segments, at a regular rate or as recorded. Nothing is NaN but what was never known."""

    name: str
    skeleton: Skeleton
    rate_hz: float
    begun_ns: int
    """Gateway time of the first frame, ns."""
    q_wb: FloatArray  # (F, S, 4) segment to world, w x y z
    p_w: FloatArray  # (F, S, 3) m, proximal joint
    joint_angles: FloatArray  # (F, J, 3) rad; NaN beyond a joint's last angle
    recorded: SkeletonArrays
    """As recorded: irregular where frames were not recorded, NaN where nothing was known."""
    filled: NDArray[np.bool_]  # (F, S) orientation put in: not known, or the frame not recorded
    axes: Axes
    subject: str = ""
    begins_s: float = 0.0
    """Time of the first frame, s: that of the files it was made from."""
    recording: Recording | None = None
    """What it was made of, for formats that hold more than poses."""
    mass_kg: float | None = None
    """Of the person, where it is known."""

    @property
    def time_s(self) -> FloatArray:
        """(F,) s; of a live recording since the first frame."""
        times: FloatArray = self.begins_s + np.arange(len(self.q_wb)) / self.rate_hz
        return times

    @property
    def angle_names(self) -> list[tuple[int, int, str]]:
        """(joint, angle, ``<joint>_<movement>``) of every column of ``joint_angles`` that means something."""
        return [
            (j, a, f"{joint.name}_{angle.name}")
            for j, joint in enumerate(self.skeleton.joints)
            for a, angle in enumerate(joint.angles)
        ]

    @property
    def tips_w(self) -> FloatArray:
        """(F, S, 3) where every segment ends, m."""
        return self.p_w + rotated(self.q_wb, self.skeleton.tips)


class TakenMarkers(NamedTuple):
    """Markers that the poses were made from, at the frames of a take, in its world axes."""

    labels: tuple[str, ...]
    positions: FloatArray  # (F, M, 3) m; NaN: not seen, or the frame not recorded
    residuals: FloatArray  # (F, M) m, from where the body has them
    used: NDArray[np.bool_]  # (F, M) had a say in the pose


def markers_of(take: Take) -> TakenMarkers | None:
    """Return the markers of a take, not interpolated; None for poses that were made of something else."""
    found = take.recorded.markers
    if found is None:
        return None
    n_frames, n = len(take.q_wb), len(found.labels)
    # A take is regular in time: each recorded frame goes to the row nearest to its instant.
    row = np.round((take.recorded.time_ns - take.begun_ns) * 1e-9 * take.rate_hz).astype(np.int64)
    positions, residuals = np.full((n_frames, n, 3), np.nan), np.full((n_frames, n), np.nan)
    used = np.zeros((n_frames, n), dtype=bool)
    positions[row] = (
        Rotation.from_euler("x", _TURNS_DEG[take.axes], degrees=True)
        .apply(found.positions.reshape(-1, 3))
        .reshape(found.positions.shape)
    )
    residuals[row], used[row] = found.residuals, found.used
    return TakenMarkers(found.labels, positions, residuals, used)


def rotated(q_wb: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return vectors (S, 3) of segment axes in world axes, (F, S, 3), by orientations (F, S, 4)."""
    frames, segments = q_wb.shape[:2]
    turned = rotation(q_wb).apply(np.tile(vectors, (frames, 1)))
    world: FloatArray = turned.reshape(frames, segments, 3)
    return world


def rotation(q: FloatArray) -> Rotation:
    """Return quaternions (…, 4) as one flat ``Rotation``."""
    return Rotation.from_quat(q.reshape(-1, 4), scalar_first=True)


def take_of(
    arrays: SkeletonArrays,
    name: str,
    axes: Axes,
    recording: Recording | None = None,
    *,
    as_recorded: bool = False,
) -> Take:
    """Make a take of a recorded result, at a regular rate unless its frames are wanted ``as_recorded``.

    Raises ``GatewayError`` with one frame, if the root is never known, or where next to nothing of the time
    was recorded.

    A segment that is never known, as its module was dead, keeps the neutral posture against its parent.
    Frames that were not recorded, and orientations that were not known, are interpolated between their
    neighbours in time; before the first and after the last known one it is repeated. Frames that are not
    later than those before are left out.
    """
    arrays, index = _in_order(arrays, name)
    if as_recorded:
        index = np.arange(len(index))
    else:
        refuse_pauses(arrays.time_ns, name)
    rate_hz = arrays.rate_hz
    grid = np.arange(index[-1] + 1)
    q_wb, filled = _filled_orientations(_known_orientations(arrays, name), index, grid)
    filled[:, _never_known(arrays)] = True
    turn = Rotation.from_euler("x", _TURNS_DEG[axes], degrees=True)
    angles = joint_angles(arrays.skeleton, q_wb)
    for s in range(q_wb.shape[1]):  # one at a time, and in place: a long session is large
        q_wb[:, s] = (turn * rotation(q_wb[:, s])).as_quat(scalar_first=True)
    places = _root_path(arrays, index, grid)
    return Take(
        name=name,
        skeleton=arrays.skeleton,
        rate_hz=rate_hz,
        begun_ns=int(arrays.time_ns[0]),
        q_wb=q_wb,
        p_w=_chained(arrays.skeleton, q_wb, turn.apply(places)),
        joint_angles=angles,
        recorded=arrays,
        filled=filled,
        axes=axes,
        begins_s=arrays.begins_s,
        recording=recording,
    )


def _in_order(arrays: SkeletonArrays, name: str) -> tuple[SkeletonArrays, IntArray]:
    """Return the frames that are later than all before them, and their places (F,) at the regular rate."""
    index = np.round((arrays.time_ns - arrays.time_ns[0]) * 1e-9 * arrays.rate_hz).astype(np.int64)
    is_later = np.diff(np.maximum.accumulate(index), prepend=-1) > 0
    if not is_later.all():
        arrays, index = arrays.only(is_later), index[is_later]
    n = len(index)
    if n < 2:
        raise GatewayError(f"{name} has {n} frame(s): a motion needs two at least")
    return arrays, index


def _never_known(arrays: SkeletonArrays) -> NDArray[np.bool_]:
    """Return which segments (S,) have no orientation in any frame."""
    return np.asarray(np.isnan(arrays.q_wb[:, :, 0]).all(axis=0))


def _known_orientations(arrays: SkeletonArrays, name: str) -> FloatArray:
    """Return the recorded orientations, those that were never known as of the segment's parent.

    Raises ``GatewayError`` for a root that was never known.
    """
    known = arrays.q_wb.copy()
    for s in np.flatnonzero(_never_known(arrays)):  # parents come first
        parent = int(arrays.skeleton.parents[s])
        if parent < 0:
            raise GatewayError(
                f"{name}: {arrays.segment_names[s]} never had an orientation, and all other segments hang "
                "from it: leave it out with another rig (replay --with), or record it again"
            )
        known[:, s] = known[:, parent]
    return known


def _filled_orientations(
    q_wb: FloatArray, index: IntArray, grid: IntArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return orientations at every instant of the grid, and which of them were filled in."""
    complete = np.empty((len(grid), q_wb.shape[1], 4))
    filled = np.ones(complete.shape[:2], np.bool_)
    for s in range(q_wb.shape[1]):
        known = ~np.isnan(q_wb[:, s, 0])
        at = index[known]
        filled[at, s] = False
        values = rotation(q_wb[known, s])
        if len(at) == 1:
            complete[:, s] = values.as_quat(scalar_first=True)
        else:
            complete[:, s] = Slerp(at, values)(np.clip(grid, at[0], at[-1])).as_quat(scalar_first=True)
        # Interpolation goes through a rotation and back: known values are written again so that they stay
        # exact.
        complete[at, s] = q_wb[known, s]
    return complete, filled


def _root_path(arrays: SkeletonArrays, index: IntArray, grid: IntArray) -> FloatArray:
    """Return the root's path (F, 3), m, interpolated linearly; the origin if it was never known."""
    root = arrays.p_w[:, int(np.flatnonzero(arrays.skeleton.parents < 0)[0])]
    known = ~np.isnan(root[:, 0])
    if not known.any():
        return np.zeros((len(grid), 3))
    return np.stack([np.interp(grid, index[known], root[known, i]) for i in range(3)], axis=1)


def _chained(skeleton: Skeleton, q_wb: FloatArray, root: FloatArray) -> FloatArray:
    """Return the proximal joints (F, S, 3) by forward kinematics, m."""
    p_w = np.empty((*q_wb.shape[:2], 3))
    for s, parent in enumerate(skeleton.parents):
        if parent < 0:
            p_w[:, s] = root
        else:
            p_w[:, s] = p_w[:, parent] + rotation(q_wb[:, parent]).apply(skeleton.offsets[s])
    return p_w
