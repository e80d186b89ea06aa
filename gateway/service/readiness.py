"""Whether a method can start at once, or its kernels have to be compiled first, and the compiling beforehand.

A method takes half a minute to a minute to compile, once after an installation: the filter over the whole
body, and the way of the body over the floor. What is compiled lies on the disk; a mark beside it says so.
``python -m gateway.service.readiness joint`` compiles in a process of its own: numba holds the
interpreter while it does, and nothing else would run well.

Until then ``FALLBACK`` serves, with a root that stays where it is: it wants the fewest kernels. These are
compiled in two processes side by side (``first_kernels``), so that the first pose comes soon.
"""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

from gateway.body.rig import load_rig
from gateway.clocks import delay_floor, floor_filter
from gateway.frames import FloatArray, ImuFrame, SkeletonFrame
from gateway.geometry import compiled
from gateway.geometry.kernel_fingerprint import fingerprint
from gateway.reconstruction import DELAYABLE, FUSED, RECONSTRUCTORS, create_reconstructor, whole_body
from gateway.reconstruction.inertial import articulated, independent, joint, rate_free
from gateway.reconstruction.whole_body import RootMode, RootSettings, WholeBodyReconstructor
from gateway.stages import frame_assembler

FALLBACK = "independent"
"""What it needs with a root that stays in its place compiles in seconds, and serves until then."""
LONG_COMPILED = frozenset(RECONSTRUCTORS) - FUSED
_RIG = "suit_17"
_DELAY_S = 0.05
"""Of methods that can have one: what goes back over past frames is compiled with the rest."""
_FIRST = "first"
_PARAMS = frame_assembler.AssemblyParams(
    frame_interval_ns=10_000_000, max_wait_ns=20_000_000, max_gap_ns=50_000_000, hold_ns=100_000_000
)
_MODULES = (articulated, floor_filter, frame_assembler, independent, joint, rate_free, whole_body)


def is_ready(name: str) -> bool:
    """Whether a method starts within seconds."""
    return name not in LONG_COMPILED or _mark(name).exists()


def make_ready(name: str) -> None:
    """Compile it, if that is still to be done; takes up to a minute then."""
    if is_ready(name):
        return
    create_reconstructor(name, load_rig(_RIG), 0.01, delay_s=_DELAY_S if name in DELAYABLE else 0.0)
    with contextlib.suppress(OSError):  # then it will be looked up again, which does no harm
        _mark(name).touch()


def command(name: str) -> list[str]:
    """What does ``make_ready`` in a process of its own."""
    return [sys.executable, "-m", "gateway.service.readiness", name]


def make_first_ready() -> None:
    """Compile what ``FALLBACK`` needs from the wire to the pose, with a root that stays in its place: half
    here and the other in a process beside this one. Takes ten seconds or more, once."""
    if _mark(_FIRST).exists():
        return
    with subprocess.Popen(command(_FIRST)) as beside:
        _compile_surroundings()
        if beside.wait() == 0:
            with contextlib.suppress(OSError):
                _mark(_FIRST).touch()


def _compile_surroundings() -> None:
    """What stands around every method."""
    suit = load_rig(_RIG)
    WholeBodyReconstructor(suit, _NothingFound(suit.skeleton.n_segments), RootSettings(RootMode.FIXED))


def _compile_fallback() -> None:
    """Module clocks, frames, and orientations module by module."""
    suit = load_rig(_RIG)
    delay_floor.warm_up()
    frame_assembler.FrameAssembler(suit.module_ids, _PARAMS)
    RECONSTRUCTORS[FALLBACK](suit, 0.01)


class _NothingFound:
    """In the place of a method: a body that nothing is known of."""

    def __init__(self, n_segments: int) -> None:
        self._n = n_segments

    def update(self, observation: ImuFrame, resting: FloatArray | None = None) -> SkeletonFrame:
        """Every segment is missing."""
        return whole_body.no_pose(self._n)

    def reset(self) -> None:
        """Nothing is remembered."""


@functools.cache
def _kernels() -> str:
    """Return the fingerprint of what the methods compile, and of what is compiled before any of them."""
    values = (value for module in _MODULES for value in vars(module).values())
    return fingerprint(value.kernel_function for value in values if isinstance(value, compiled.Kernel))


def _mark(name: str) -> Path:
    return compiled.CACHE_DIRECTORY / f"ready-{name}-{_kernels()}-numba-{version('numba')}"


if __name__ == "__main__":
    for wanted in sys.argv[1:]:
        if wanted == _FIRST:
            _compile_fallback()
            continue
        if wanted not in RECONSTRUCTORS:
            sys.exit(f"no method is called '{wanted}'")
        with contextlib.suppress(OSError):
            os.nice(19)  # whoever waits for it runs meanwhile
        make_ready(wanted)
