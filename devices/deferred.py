"""What is used of SciPy and VQF, imported when it is first called.

Importing SciPy takes a third of a second, VQF a tenth; most commands, and the help of all, never call them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scipy.interpolate import BPoly, CubicSpline, make_interp_spline
    from scipy.io import loadmat
    from scipy.ndimage import gaussian_filter1d
    from scipy.optimize import least_squares, minimize, nnls
    from scipy.signal import butter, correlate, lfilter, sosfilt, sosfilt_zi, sosfiltfilt
    from scipy.spatial.transform import Rotation, Slerp
    from scipy.special import expit
    from scipy.stats import theilslopes
    from vqf import VQF, offlineVQF
else:

    class _Deferred:
        """Stands for a function or class, whose calls and attributes it passes on."""

        def __init__(self, module: str, name: str) -> None:
            self._module, self._name = module, name

        def _found(self) -> Any:
            return getattr(importlib.import_module(self._module), self._name)

        def __call__(self, *arguments: Any, **options: Any) -> Any:
            return self._found()(*arguments, **options)

        def __getattr__(self, name: str) -> Any:
            return getattr(self._found(), name)

    BPoly = _Deferred("scipy.interpolate", "BPoly")
    CubicSpline = _Deferred("scipy.interpolate", "CubicSpline")
    Rotation = _Deferred("scipy.spatial.transform", "Rotation")
    Slerp = _Deferred("scipy.spatial.transform", "Slerp")
    butter = _Deferred("scipy.signal", "butter")
    correlate = _Deferred("scipy.signal", "correlate")
    expit = _Deferred("scipy.special", "expit")
    gaussian_filter1d = _Deferred("scipy.ndimage", "gaussian_filter1d")
    least_squares = _Deferred("scipy.optimize", "least_squares")
    lfilter = _Deferred("scipy.signal", "lfilter")
    loadmat = _Deferred("scipy.io", "loadmat")
    make_interp_spline = _Deferred("scipy.interpolate", "make_interp_spline")
    minimize = _Deferred("scipy.optimize", "minimize")
    nnls = _Deferred("scipy.optimize", "nnls")
    sosfilt = _Deferred("scipy.signal", "sosfilt")
    sosfilt_zi = _Deferred("scipy.signal", "sosfilt_zi")
    sosfiltfilt = _Deferred("scipy.signal", "sosfiltfilt")
    theilslopes = _Deferred("scipy.stats", "theilslopes")
    VQF = _Deferred("vqf", "VQF")
    offlineVQF = _Deferred("vqf", "offlineVQF")  # noqa: N816 - its own name

__all__ = [
    "VQF",
    "BPoly",
    "CubicSpline",
    "Rotation",
    "Slerp",
    "butter",
    "correlate",
    "expit",
    "gaussian_filter1d",
    "least_squares",
    "lfilter",
    "loadmat",
    "make_interp_spline",
    "minimize",
    "nnls",
    "offlineVQF",
    "sosfilt",
    "sosfilt_zi",
    "sosfiltfilt",
    "theilslopes",
]
