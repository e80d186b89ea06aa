"""Other people's filters on the same frames, each result computed once.

VQF comes with the gateway. The others live in an environment of their own, since some hold other versions of
what the gateway needs: ``MOCAP_PEERS`` names its Python interpreter; without it, this one is tried::

    python3.11 -m venv peers && peers/bin/pip install imufusion ahrs qmt imt-ring
    MOCAP_PEERS=$PWD/peers/bin/python python -m benchmarks never_worse
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from vqf import VQF, offlineVQF

from benchmarks.never_worse import store
from benchmarks.never_worse.case import Case
from gateway.frames import FloatArray

VARIABLE = "MOCAP_PEERS"
VQF_6, VQF_9 = "VQF 6", "VQF 9"
WITHOUT_FIELD = frozenset({VQF_6, "VQF offline 6", "qmt"})
"""Peers that use no field even where there is one."""
_CHILD = Path(__file__).with_name("peer_child.py")
_LONGEST_S = 1800.0
_WANTED = {
    "imufusion": "imufusion",
    "ahrs": "Madgwick, Mahony and EKF",
    "qmt": "its joint constraints",
}


@cache
def versions() -> dict[str, str]:
    """Return versions of the peers that are installed. Raises ``RuntimeError`` where that cannot be asked."""
    command = [_interpreter(), "-I", str(_CHILD), "versions"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120.0, check=False)
    except OSError as error:
        raise RuntimeError(f"{_interpreter()}: not a Python interpreter ({error.strerror})") from error
    if done.returncode != 0:
        raise RuntimeError(f"{_interpreter()}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    found: dict[str, str] = json.loads(done.stdout)
    return found


def skipped() -> list[str]:
    """Return the peers that are left out, each with the reason."""
    there = versions()
    reasons = [
        f"{name} ({what}): not installed, see {VARIABLE}"
        for name, what in _WANTED.items()
        if name not in there
    ]
    state = f"version {there['imt-ring']} is installed" if "imt-ring" in there else "not installed"
    return [*reasons, f"imt-ring: {state}; its package has no trained weights"]


def vqf(case: Case) -> dict[str, FloatArray]:
    """Return (T, S, 4) ``q_wb`` of VQF, 6-axis and offline, and 9-axis where there is a field."""
    key = store.digest("vqf", metadata.version("vqf"), Path(__file__).read_text(), store.input_digest(case))
    return store.kept(f"vqf-{key}", lambda: _by_vqf(case))


def others(case: Case) -> dict[str, FloatArray]:
    """Return (T, S, 4) ``q_wb`` by every other peer that is installed."""
    there = json.dumps(versions(), sort_keys=True)
    hinges = sorted(case.hinges.items())
    key = store.digest("peers", _CHILD.read_text(), there, hinges, store.input_digest(case))
    return store.kept(f"peers-{key}", lambda: _by_others(case))


def _interpreter() -> str:
    return os.environ.get(VARIABLE) or sys.executable


def _sensed(case: Case) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rates, specific forces and fields (T, S, 3), segment axes; what is missing as it was last."""
    q_sb = Rotation.from_quat(case.suit.sensor_to_segment, scalar_first=True)
    rows = case.suit.module_of_segment
    assert (rows >= 0).all(), "peers need a module on every segment"

    def of(sensor: str) -> FloatArray:
        values = _filled(np.stack([getattr(frame, sensor) for frame in case.frames])[:, rows])
        return np.stack([q_sb[s].apply(values[:, s]) for s in range(len(rows))], axis=1)

    return of("angular_rate"), of("specific_force"), of("magnetic_field")


def _by_vqf(case: Case) -> dict[str, FloatArray]:
    found: dict[str, list[FloatArray]] = {}
    for each in zip(*(np.moveaxis(values, 1, 0) for values in _sensed(case)), strict=True):
        gyr, acc, mag = (np.ascontiguousarray(values) for values in each)
        dt = case.interval_s
        solved = {VQF_6: VQF(dt).updateBatch(gyr, acc)["quat6D"]}
        solved["VQF offline 6"] = offlineVQF(gyr, acc, None, dt)["quat6D"]
        if np.isfinite(mag).all():
            solved[VQF_9] = VQF(dt).updateBatch(gyr, acc, mag)["quat9D"]
            solved["VQF offline 9"] = offlineVQF(gyr, acc, mag, dt)["quat9D"]
        for name, q_wb in solved.items():
            found.setdefault(name, []).append(q_wb)
    return {name: np.stack(columns, axis=1) for name, columns in found.items()}


def _by_others(case: Case) -> dict[str, FloatArray]:
    arrays = dict(zip(("gyr", "acc", "mag"), _sensed(case), strict=True)) | {"q6": vqf(case)[VQF_6]}
    field = case.suit.magnetic_field
    dip = float(np.degrees(np.arctan2(-field[2], np.hypot(field[0], field[1]))))
    parents = case.suit.skeleton.parents
    hinges = [[float(parents[child]), float(child), *axis] for child, axis in sorted(case.hinges.items())]
    with tempfile.TemporaryDirectory() as folder:
        given, answer = Path(folder) / "case.npz", Path(folder) / "answer.npz"
        np.savez(
            given, allow_pickle=False, dt=case.interval_s, dip_deg=dip, hinges=np.array(hinges), **arrays
        )
        done = subprocess.run(
            [_interpreter(), "-I", str(_CHILD), str(given), str(answer)],
            capture_output=True, text=True, timeout=_LONGEST_S, check=False,
        )  # fmt: skip
        if done.returncode != 0:
            raise RuntimeError(
                f"peers of {case.name}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}"
            )
        with np.load(answer) as found:
            if failed := json.loads(str(found["failed"])):
                print(f"{case.name}: {failed}", flush=True)
            return {name: found[name] for name in found.files if name != "failed"}


def _filled(values: FloatArray) -> FloatArray:
    """(T, n, 3) each value that is missing as the last one before it, or the first after."""
    result = values.copy()
    for column in np.moveaxis(result, 1, 0):
        sound = np.isfinite(column).all(axis=1)
        if sound.any():
            last = np.maximum.accumulate(np.where(sound, np.arange(len(column)), -1))
            column[:] = column[np.where(last >= 0, last, np.flatnonzero(sound)[0])]
    return result
