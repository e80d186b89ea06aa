"""Compiles what a stream of markers needs, before the first of them comes."""

from __future__ import annotations

import functools

import numpy as np

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import MarkerFrame
from gateway.reconstruction.optical.rates import WINDOW
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor

_INTERVAL_NS = 10_000_000
_MARKERS_EACH = 4


@functools.cache
def warm_up() -> None:
    """A chain of two segments is seen standing still until its angular rates are known.

    Kernels are compiled for kinds of arrays, not for their sizes: any body has its own then. The first call
    after an installation takes about 25 s, the first of a process under a second, others nothing.
    """
    offsets = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    body = Skeleton("warm_up", ("upper", "lower"), np.array([-1, 0]), offsets, np.roll(offsets, -1, axis=0))
    segments = np.repeat([0, 1], _MARKERS_EACH)
    places = np.random.default_rng(0).normal(0.0, 0.1, (len(segments), 3))
    labels = tuple(f"m{i}" for i in range(len(segments)))
    markers = BodyMarkers(labels, segments, places, np.full(len(segments), 0.005))
    reconstructor = OpticalReconstructor(body, markers)
    seen = places + offsets[segments]
    for frame in range(WINDOW + 1):
        reconstructor.update(MarkerFrame(frame, frame * _INTERVAL_NS, seen))
