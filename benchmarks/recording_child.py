"""A recorder in a process of its own, to be killed: 17 modules at 100 Hz, chunks and poses, in real time.

``python -m benchmarks.recording_child FOLDER FLUSH_MS``. Prints the file's path, then runs until killed.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from devices.link import Chunk, Framing, gateway_time_ns
from gateway.frames import SkeletonFrame
from gateway.recording.files import Contents, SessionFiles
from gateway.recording.recorder import Recorder, RecordingSink
from gateway.settings import RecordingSettings

N_MODULES = 17
TICK_S = 0.01
CHUNK_BYTES = 60 * N_MODULES


def main() -> None:
    """Hand over a chunk and a pose every tick, and forget nothing."""
    settings = RecordingSettings(
        folder=sys.argv[1], flush_ms=float(sys.argv[2]), min_free_mb=1, warn_free_mb=1
    )
    files = SessionFiles(settings, Contents({"suit": Framing.BYTE_STREAM}, {}, "bench", True))
    recorder = Recorder(
        RecordingSink(files.write, files.flush, files.close, files.abandon), settings.flush_ms * 1e-3
    )
    rng = np.random.default_rng(1)
    print(files.path, flush=True)
    tick, start = 0, time.monotonic()
    while True:
        recorder.chunk(Chunk(rng.bytes(CHUNK_BYTES), gateway_time_ns(), "suit"), Framing.BYTE_STREAM)
        recorder.skeleton(_pose(rng, tick), gateway_time_ns())
        tick += 1
        time.sleep(max(start + tick * TICK_S - time.monotonic(), 0.0))


def _pose(rng: np.random.Generator, tick: int) -> SkeletonFrame:
    def values(width: int) -> np.ndarray:
        return rng.normal(size=(N_MODULES, width))

    return SkeletonFrame(
        sequence=tick,
        time_ns=gateway_time_ns(),
        q_wb=values(4),
        angular_rate=values(3),
        joint_acceleration=values(3),
        p_w=values(3),
        sigma=values(1)[:, 0],
        status=np.zeros(N_MODULES, dtype=np.uint8),
        root=0,
    )


if __name__ == "__main__":
    main()
