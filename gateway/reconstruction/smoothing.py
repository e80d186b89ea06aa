"""A whole recording at once: every orientation from the measurements before and after it.

Forward through the frames with the filter of ``inertial.tree``, backward with the same (``tree.smoothing``),
and forward once more for what stands around the filter (segments without module, the place in the world). In
between, blocks of frames lie in files of a temporary folder: memory does not grow with the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gateway.errors import GatewayError
from gateway.frames import (
    FloatArray,
    ImuFrame,
    IntArray,
    LocalReading,
    Quantity,
    SkeletonFrame,
    Status,
    StatusArray,
)
from gateway.reconstruction.inertial.tree.headings import sight_of, stacked_sights
from gateway.reconstruction.inertial.tree.reconstructor import ChainReconstructor
from gateway.reconstruction.inertial.tree.smoothing import put_together, seen_backward
from gateway.reconstruction.reconstructor import Reconstructor
from gateway.reconstruction.stacked_frames import POSE_ARRAYS, Poses
from gateway.reconstruction.whole_body import WholeBodyReconstructor

FRAMES_A_BLOCK = 1024
SMOOTHED = ("joint", "outward")
"""Reconstructors that can go backward."""

Progress = Callable[[int, int], None]

_READING = np.dtype(
    [
        ("frame", "i8"),
        ("device", "i8"),
        ("time_ns", "i8"),
        ("quantity", "i8"),
        ("value", "f8", 3),
        ("sigma", "f8", 3),
    ]
)
"""A ``LocalReading``, and the frame of its block that it belongs to."""


@dataclass
class _Block:
    """Some successive frames: what was observed, and what the forward filter made of it. T frames, m modules,
    n segments, k readings of local devices; as in ``ImuFrame`` and ``SkeletonFrame``."""

    sequence: IntArray  # (T,)
    time_ns: IntArray  # (T,)
    specific_force: FloatArray  # (T, m, 3)
    observed_rate: FloatArray  # (T, m, 3)
    magnetic_field: FloatArray  # (T, m, 3)
    observed_status: StatusArray  # (T, m)
    clipped: StatusArray  # (T, m)
    sights: FloatArray  # (T, m + 1, 4) see ``stacked_sights``
    stood_s: FloatArray  # (T, n)
    step_s: FloatArray  # (T,)
    readings: NDArray[np.void]  # (k,) ``_READING``
    q_wb: FloatArray  # (T, n, 4)
    angular_rate: FloatArray  # (T, n, 3)
    joint_acceleration: FloatArray  # (T, n, 3)
    p_w: FloatArray  # (T, n, 3)
    sigma: FloatArray  # (T, n)
    status: StatusArray  # (T, n)
    root: IntArray  # (T,)
    covariance: FloatArray  # (T, n, 2, 3, 3) the estimate's own, and the published one

    def frames(self) -> list[ImuFrame]:
        """Return what was observed, stuck modules left out."""
        local: list[list[LocalReading]] = [[] for _ in self.time_ns]
        for row in self.readings:
            quantity = Quantity(int(row["quantity"]))
            local[row["frame"]].append(
                LocalReading(int(row["device"]), int(row["time_ns"]), quantity, row["value"], row["sigma"])
            )
        nothing = np.zeros(self.observed_status.shape[1], np.int64)
        return [
            ImuFrame(
                sequence=int(self.sequence[t]),
                time_ns=int(self.time_ns[t]),
                specific_force=self.specific_force[t],
                angular_rate=self.observed_rate[t],
                magnetic_field=self.magnetic_field[t],
                status=self.observed_status[t],
                gap_ns=nothing,
                local=tuple(local[t]),
                sun=sight_of(self.sights[t]),
                clipped=self.clipped[t],
            )
            for t in range(len(self.time_ns))
        ]

    def found(self) -> Poses:
        """Return the poses that the filter has found."""
        return Poses(
            self.sequence.tolist(), self.time_ns.tolist(), self.q_wb, self.angular_rate,
            self.joint_acceleration, self.p_w, self.sigma, self.status, self.root,
        )  # fmt: skip


class Smoother:
    """``add`` all frames, in time order, then take ``smoothed``."""

    def __init__(self, body: Reconstructor, folder: Path) -> None:
        """Create a smoother that has seen no frame.

        body: a reconstructor that has seen none either. folder: empty, for the blocks. Raises
        ``GatewayError`` for a method that cannot go backward.
        """
        if not isinstance(body, WholeBodyReconstructor) or not isinstance(body.finder, ChainReconstructor):
            raise GatewayError(
                f"smoothing is for the methods {' and '.join(SMOOTHED)}: add --reconstructor {SMOOTHED[0]}"
            )
        self._body, self._forward, self._folder = body, body.finder, folder
        self._waiting: list[ImuFrame] = []
        self._n_blocks = 0
        self._end_ns = 0

    def add(self, frames: Sequence[ImuFrame]) -> None:
        """Take frames in time order, later than those before. Raises ``OSError`` where the disk is full."""
        self._waiting.extend(frames)
        while len(self._waiting) >= FRAMES_A_BLOCK:
            self._go_forward(self._waiting[:FRAMES_A_BLOCK])
            del self._waiting[:FRAMES_A_BLOCK]

    def smoothed(self, progress: Progress | None = None) -> Iterator[SkeletonFrame]:
        """Yield the smoothed poses of all frames added, in time order.

        progress: called with the number of blocks done and twice the number of blocks.
        """
        if self._waiting:
            self._go_forward(self._waiting)
            self._waiting = []
        report = progress or (lambda done, total: None)
        total = 2 * self._n_blocks
        backward = self._forward.turned_back()
        later: list[LocalReading] = []
        for k in reversed(range(self._n_blocks)):
            later = self._go_backward(k, backward, later)
            report(self._n_blocks - k, total)
        for k in range(self._n_blocks):
            report(self._n_blocks + k + 1, total)  # before: who takes the last pose asks for no more
            yield from self._finished(k)

    def covariance(self) -> FloatArray:
        """Return that of the errors of what ``smoothed`` has yielded, (T, n, 3, 3) rad², world axes."""
        return np.concatenate([self._read(k).covariance[:, :, 1] for k in range(self._n_blocks)])

    def _go_forward(self, frames: Sequence[ImuFrame]) -> None:
        prepared = self._body.prepare(frames)
        clean, seen, stood_s = prepared.observations, prepared.frames, prepared.stood_s
        covariance = np.empty((*stood_s.shape, 2, 3, 3))
        found = self._forward.poses(clean, seen, stood_s, covariance)

        readings = [(t, reading) for t, frame in enumerate(clean) for reading in frame.local]
        block = _Block(
            sequence=np.array([frame.sequence for frame in clean], np.int64),
            time_ns=seen.time_ns,
            specific_force=seen.specific_force,
            observed_rate=seen.angular_rate,
            magnetic_field=seen.magnetic_field,
            observed_status=seen.status,
            clipped=seen.clipped,
            sights=stacked_sights(clean),
            stood_s=stood_s,
            step_s=prepared.segments.dt,
            readings=np.array(
                [(t, r.device, r.time_ns, r.quantity, r.value, r.sigma) for t, r in readings], _READING
            ),
            **{name: getattr(found, name) for name in (*POSE_ARRAYS, "root")},
            covariance=covariance,
        )

        self._end_ns = int(block.time_ns[-1])
        self._write(self._n_blocks, block)
        self._n_blocks += 1

    def _go_backward(
        self, k: int, backward: ChainReconstructor, later: list[LocalReading]
    ) -> list[LocalReading]:
        block = self._read(k)
        frames, earlier = seen_backward(block.frames(), self._end_ns, later)
        covariance = np.empty((*block.sigma.shape, 2, 3, 3))
        found = backward.update_many(frames, np.ascontiguousarray(block.stood_s[::-1]), covariance)[::-1]
        q_back = np.stack([frame.q_wb for frame in found])
        known_later = np.isnan(block.q_wb[..., 0]) & np.isfinite(q_back[..., 0])
        sigma_back = np.stack([frame.sigma for frame in found])
        P_back = np.ascontiguousarray(covariance[::-1])
        put_together(block.q_wb, block.covariance, block.sigma, q_back, P_back, sigma_back)
        block.status[known_later] = Status.PREDICTED
        block.angular_rate = _mean(block.angular_rate, -np.stack([frame.angular_rate for frame in found]))
        block.joint_acceleration = _mean(
            block.joint_acceleration, np.stack([frame.joint_acceleration for frame in found])
        )
        self._write(k, block)
        return earlier

    def _finished(self, k: int) -> Iterator[SkeletonFrame]:
        block = self._read(k)
        prepared = self._body.prepared_again(block.frames(), block.stood_s, block.step_s)
        yield from self._body.finish(block.found(), prepared)

    def _path(self, k: int) -> Path:
        return self._folder / f"{k:06d}.npz"

    def _write(self, k: int, block: _Block) -> None:
        np.savez(self._path(k), **asdict(block))

    def _read(self, k: int) -> _Block:
        with np.load(self._path(k)) as arrays:
            return _Block(**arrays)


def _mean(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the mean of what is not NaN: both are off in time, one as late as the other is early."""
    mean: FloatArray = np.where(np.isnan(a), b, np.where(np.isnan(b), a, 0.5 * (a + b)))
    return mean
