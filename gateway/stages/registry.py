"""The stages by what they take: every kind of observation has one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gateway.frames import (
    FusedReading,
    HeatMapFrame,
    InertialBatch,
    LightReading,
    LocalReading,
    MarkerFrame,
    Observation,
)
from gateway.stages.cameras import CameraStage
from gateway.stages.markers import MarkerStage
from gateway.stages.modules import ModuleStage
from gateway.stages.stage import Stage, StageContext

STAGES: dict[type[Observation], Callable[[StageContext], Stage[Any]]] = {
    InertialBatch: ModuleStage,
    FusedReading: ModuleStage,
    LocalReading: ModuleStage,
    LightReading: ModuleStage,
    MarkerFrame: MarkerStage,
    HeatMapFrame: CameraStage,
}
