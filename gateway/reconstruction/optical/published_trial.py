"""A whole trial of a fitted subject by the published method: markers in, skeleton frames out, offline."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray, SkeletonFrame, Status
from gateway.geometry import quaternion
from gateway.reconstruction.optical.pose_solver import BodyModel, body_model
from gateway.reconstruction.optical.published import Progress, PublishedMotion, Trial, solve_published
from gateway.reconstruction.optical.rates import Rates
from gateway.reconstruction.optical.tracking import start_pose


@dataclass(frozen=True)
class PublishedTrial:
    """Poses of F frames, and how they explain the M markers."""

    motion: PublishedMotion
    p_w: FloatArray  # (F, S, 3) m
    virtual: FloatArray  # (F, M, 3) m, where the body has its markers
    residuals: FloatArray  # (F, M) m; NaN where a marker was not seen
    seen: NDArray[np.bool_]  # (F, M); the method leaves nothing out

    def frames(self, times_ns: list[int]) -> Iterator[SkeletonFrame]:
        """Yield skeleton frames at these F instants. ``sigma`` is NaN: the method gives none.

        A segment is measured with a marker of its own in sight, else predicted; held with no marker at all.
        """
        rates, n = Rates(), self.p_w.shape[1]
        for f, time_ns in enumerate(times_ns):
            R, p = self.motion.R[f], self.p_w[f]
            rate, acceleration = rates.add(time_ns, R, p)
            status = np.full(n, Status.PREDICTED if self.seen[f].any() else Status.HELD, dtype=np.uint8)
            status[self.motion.markers.segments[self.seen[f]]] = Status.MEASURED
            q_wb = np.stack([quaternion.from_matrix(each) for each in R])
            yield SkeletonFrame(
                sequence=f,
                time_ns=time_ns,
                q_wb=q_wb,
                angular_rate=rate,
                joint_acceleration=acceleration,
                p_w=p,
                sigma=np.full(n, np.nan),
                status=status,
                root=0,
            )


def published_trial(
    skeleton: Skeleton,
    markers: BodyMarkers,
    observed: FloatArray,
    rate_hz: float,
    progress: Progress | None = None,
    *,
    refine: bool = True,
) -> PublishedTrial:
    """Solve observed (F, M, 3), world m, NaN unseen. refine: see ``solve_published``.

    The subject's fit stands for the method's steps 1 to 4 (local frames, bone lengths, first virtual
    markers); the pose begins where the first frame with enough markers lays that body.
    Raises ``GatewayError`` where no frame has three markers.
    """
    model = body_model(skeleton, markers)
    neutral = quaternion.to_matrix(skeleton.neutral)
    begun = next((pose for seen in observed if (pose := start_pose(model, seen, neutral)) is not None), None)
    if begun is None:
        raise GatewayError("no frame has three markers of the subject: there is nothing to solve")
    n = len(observed)
    axes, root = np.tile(begun.R, (n, 1, 1, 1)), np.tile(begun.root, (n, 1))
    motion = solve_published(
        skeleton, markers, Trial(observed, rate_hz, axes, root), refine=refine, progress=progress
    )
    return _explained(body_model(skeleton, motion.markers), motion, observed)


def _explained(model: BodyModel, motion: PublishedMotion, observed: FloatArray) -> PublishedTrial:
    p_w = np.stack([model.joints_at(R, root) for R, root in zip(motion.R, motion.root, strict=True)])
    virtual = p_w[:, model.segments] + np.einsum("fmij,mj->fmi", motion.R[:, model.segments], model.positions)
    residuals: FloatArray = np.linalg.norm(observed - virtual, axis=2)
    seen: NDArray[np.bool_] = np.isfinite(residuals)
    return PublishedTrial(motion, p_w, virtual, residuals, seen)
