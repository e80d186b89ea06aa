"""What a body calibration found out: of every module its rotation, its place, and how good they are."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gateway.calibration.axes import MovementAxis
from gateway.calibration.evidence import FieldHeading, HeldPose
from gateway.calibration.quality import Quality
from gateway.errors import GatewayError, nearest
from gateway.frames import FloatArray


@dataclass
class ModuleEvidence:
    """What one module did in the steps, before anything is solved."""

    segment: str
    module: int
    poses: dict[str, HeldPose] = field(default_factory=dict)
    movements: dict[str, MovementAxis | None] = field(default_factory=dict)
    """By step; None: it did not turn at all."""
    earth_field: FieldHeading | None = None
    unreceived: list[str] = field(default_factory=list)
    """Steps during which it was silent."""
    has_no_heading: bool = False


@dataclass(frozen=True, eq=False)
class ModuleResult:
    """How one module sits."""

    module: int
    segment: str
    quality: Quality
    sensor_to_segment: FloatArray | None
    """(4,) ``q_bs``; None: not found."""
    position: FloatArray
    """(3,) proximal joint to module, segment axes, m: ``U``."""
    rotation_sigma: float
    """rad, of the worst axis."""
    position_sigma: float
    """m, of the worst component."""


@dataclass(frozen=True, eq=False)
class BodyResult:
    """Of all modules of a suit."""

    modules: tuple[ModuleResult, ...]
    facing: float
    """Heading of the wearer in the poses, rad, anticlockwise from east; 0 without a field."""
    joints: FloatArray
    """(n_segments, 3) joints on their parents as the motion has them, m: ``L``."""
    steps: list[str]
    """Those that were done."""

    @property
    def score(self) -> float:
        """That of the worst module."""
        return min(module.quality.score for module in self.modules)

    def accepted(
        self, segments: Collection[str] | None = None, with_poor: bool = False
    ) -> list[ModuleResult]:
        """Return those to be used: found, not poor unless wanted, and of the segments given.

        Raises ``GatewayError`` for a segment without module.
        """
        names = [module.segment for module in self.modules]
        for segment in segments or ():
            if segment not in names:
                raise GatewayError(f"no module sits on '{segment}'{nearest(segment, names)}")
        return [
            module
            for module in self.modules
            if module.sensor_to_segment is not None
            and (segments is None or module.segment in segments)
            and (with_poor or module.quality.verdict != "poor")
        ]

    def as_json(self) -> dict[str, Any]:
        """Return the result for scripts and requests, in degrees and metres."""
        return {
            "score": round(self.score, 3),
            "facing_deg": round(float(np.degrees(self.facing)), 1),
            "steps": self.steps,
            "modules": [
                {
                    "module": one.module,
                    "segment": one.segment,
                    "score": round(one.quality.score, 3),
                    "quality": one.quality.verdict,
                    "reasons": list(one.quality.reasons),
                    "sensor_to_segment": None
                    if one.sensor_to_segment is None
                    else one.sensor_to_segment.tolist(),
                    "position": one.position.tolist(),
                    "rotation_sigma_deg": _rounded(np.degrees(one.rotation_sigma)),
                    "position_sigma_m": _rounded(one.position_sigma),
                }
                for one in self.modules
            ],
        }


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
