"""What may be asked about calibrations and resets, and with which data."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

SegmentName = Annotated[str, Field(max_length=40)]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class BeginCalibrationRequest(_Request):
    """Begin a body calibration; one under way is given up. Answers with the steps to do."""

    field: bool = Field(default=True, description="magnetometers tell headings; false: only the movements do")


class CalibrationStepRequest(_Request):
    """Do a step: counts down, then records. Answers at once; `calibration/status` says how far it is."""

    step: str = Field(max_length=40, description="one of the steps that `calibration/begin` told")
    countdown_s: float = Field(default=3.0, ge=0, le=30, description="time to get ready, s")
    seconds: float | None = Field(default=None, ge=1, le=120, description="how long; none: as planned")
    segments: list[SegmentName] | None = Field(
        default=None, max_length=64, description="only these are done again; none: all"
    )


class CalibrationStatusRequest(_Request):
    """How far it is, and what every module does at the moment."""


class CalibrationResultRequest(_Request):
    """What the steps done so far give: a score for each module, and why when it is not good."""


class AcceptCalibrationRequest(_Request):
    """Use the result from now on, and keep it in a rig file where one is named."""

    segments: list[SegmentName] | None = Field(
        default=None, max_length=64, description="only these; none: all that are not poor"
    )
    poor: bool = Field(default=False, description="take poor results too")
    save: bool = Field(
        default=False,
        description="write the configuration's rig file too, or `<rig>.worn.yaml` for a shipped one",
    )


class CancelCalibrationRequest(_Request):
    """Give it up; nothing changes."""


class CalibrationHistoryRequest(_Request):
    """Earlier versions of the rig file that `accept` writes."""


class RestoreCalibrationRequest(_Request):
    """Put an earlier version of the rig file back, and wear the suit by it."""

    version: str | None = Field(default=None, max_length=40, description="as listed; none: the newest")


REQUESTS: dict[str, type[BaseModel]] = {
    "begin": BeginCalibrationRequest,
    "step": CalibrationStepRequest,
    "status": CalibrationStatusRequest,
    "result": CalibrationResultRequest,
    "accept": AcceptCalibrationRequest,
    "cancel": CancelCalibrationRequest,
    "history": CalibrationHistoryRequest,
    "restore": RestoreCalibrationRequest,
}
"""Verb to the data it takes."""


class HeadingResetRequest(_Request):
    """Turn the world so that the wearer faces a direction."""

    facing_deg: float = Field(
        default=0.0, ge=-360, le=360, description="heading afterwards, anticlockwise from east"
    )


class FullResetRequest(_Request):
    """Heading and mounting at once: stand in the N-pose."""

    facing_deg: float = Field(
        default=0.0, ge=-360, le=360, description="heading afterwards, anticlockwise from east"
    )


class MountingResetRequest(_Request):
    """Take every segment to be in the neutral posture now: stand in the N-pose."""


RESET_REQUESTS: dict[str, type[BaseModel]] = {
    "heading": HeadingResetRequest,
    "full": FullResetRequest,
    "mounting": MountingResetRequest,
}
