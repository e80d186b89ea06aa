"""What is slow to import, imported when it is first called: ``Deferred``, and what is used of SciPy and VQF.

Importing SciPy takes a third of a second, VQF a tenth; most commands, and the help of all, never call them.
"""

from __future__ import annotations

import functools
import importlib
from typing import TYPE_CHECKING, Any


class Deferred:
    """Stands for a function or class, whose calls and attributes it passes on."""

    def __init__(self, module: str, name: str) -> None:
        """Stand for ``name`` (also ``Class.method``) of ``module``, which is imported at the first call."""
        self._module, self._name = module, name

    def _found(self) -> Any:
        return functools.reduce(getattr, self._name.split("."), importlib.import_module(self._module))

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Import it, and call it."""
        return self._found()(*arguments, **options)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._found(), name)


if TYPE_CHECKING:
    from scipy.interpolate import BPoly, CubicSpline, make_interp_spline
    from scipy.io import loadmat
    from scipy.ndimage import gaussian_filter1d
    from scipy.optimize import least_squares, minimize, nnls
    from scipy.signal import butter, correlate, lfilter, sosfilt, sosfilt_zi, sosfiltfilt
    from scipy.spatial.transform import Rotation, RotationSpline, Slerp
    from scipy.special import expit
    from scipy.stats import theilslopes
    from vqf import VQF, offlineVQF
else:
    BPoly = Deferred("scipy.interpolate", "BPoly")
    CubicSpline = Deferred("scipy.interpolate", "CubicSpline")
    Rotation = Deferred("scipy.spatial.transform", "Rotation")
    RotationSpline = Deferred("scipy.spatial.transform", "RotationSpline")
    Slerp = Deferred("scipy.spatial.transform", "Slerp")
    butter = Deferred("scipy.signal", "butter")
    correlate = Deferred("scipy.signal", "correlate")
    expit = Deferred("scipy.special", "expit")
    gaussian_filter1d = Deferred("scipy.ndimage", "gaussian_filter1d")
    least_squares = Deferred("scipy.optimize", "least_squares")
    lfilter = Deferred("scipy.signal", "lfilter")
    loadmat = Deferred("scipy.io", "loadmat")
    make_interp_spline = Deferred("scipy.interpolate", "make_interp_spline")
    minimize = Deferred("scipy.optimize", "minimize")
    nnls = Deferred("scipy.optimize", "nnls")
    sosfilt = Deferred("scipy.signal", "sosfilt")
    sosfilt_zi = Deferred("scipy.signal", "sosfilt_zi")
    sosfiltfilt = Deferred("scipy.signal", "sosfiltfilt")
    theilslopes = Deferred("scipy.stats", "theilslopes")
    VQF = Deferred("vqf", "VQF")
    offlineVQF = Deferred("vqf", "offlineVQF")  # noqa: N816 - its own name

__all__ = [
    "VQF",
    "BPoly",
    "CubicSpline",
    "Deferred",
    "Rotation",
    "RotationSpline",
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
