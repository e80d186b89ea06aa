"""What does not change is computed once: cases by the files and the code they come from, peers' results by
their input.

``MOCAP_BENCH_CACHE`` names the folder, or there is one in the user's cache. It may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from benchmarks.never_worse.case import Case

T = TypeVar("T")
ROOT = Path(__file__).parents[2]
CODE = (
    "benchmarks/foot_recording.py",
    "benchmarks/never_worse/case.py",
    "benchmarks/never_worse/losses.py",
    "benchmarks/never_worse/recordings.py",
    "benchmarks/never_worse/simulated.py",
    "benchmarks/never_worse/split.py",
    "config",
    "devices/emulators",
    "devices/recorded_tracks.py",
    "firmware_protocol",
    "gateway/body",
    "gateway/clocks",
    "gateway/emulation",
    "gateway/frames.py",
    "gateway/pipeline.py",
    "gateway/sources",
    "gateway/stages",
)
"""What the frames of a case are made by; not the estimators, which are what is tried."""


def folder() -> Path:
    """Where results are kept."""
    if chosen := os.environ.get("MOCAP_BENCH_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mocap-gateway" / "never_worse"


def kept(key: str, make: Callable[[], T]) -> T:
    """Return what is kept under a key, or make and keep it."""
    path = folder() / f"{key}.pickle"
    if path.is_file():
        try:
            found: T = pickle.loads(path.read_bytes())
            return found
        except (pickle.UnpicklingError, EOFError, AttributeError, ImportError):
            path.unlink(missing_ok=True)
    value = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.write_bytes(pickle.dumps(value))
    beside.replace(path)
    return value


def digest(*parts: object) -> str:
    """Return a key of strings, arrays and lists of arrays."""
    total = hashlib.sha256()
    for each in parts:
        if isinstance(each, np.ndarray):
            total.update(str((each.shape, each.dtype)).encode())
            total.update(np.ascontiguousarray(each).tobytes())
        else:
            total.update(repr(each).encode())
        total.update(b"|")
    return total.hexdigest()[:32]


@cache
def code_digest() -> str:
    """Return a key of all code that makes cases."""
    roots = [ROOT / name for name in CODE]
    paths = [path for root in roots for path in ([root] if root.is_file() else sorted(root.rglob("*.*")))]
    kept_in = [path for path in paths if path.suffix in {".py", ".yaml"}]
    return digest(*[(path.relative_to(ROOT).as_posix(), path.read_text()) for path in kept_in])


def input_digest(case: Case) -> str:
    """Return a key of what the modules of a case measured."""
    arrays = (
        np.stack([getattr(frame, name) for frame in case.frames])
        for name in ("specific_force", "angular_rate", "magnetic_field")
    )
    return digest(case.interval_s, case.suit.sensor_to_segment, case.suit.magnetic_field, *arrays)
