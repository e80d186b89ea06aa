"""What may be asked about recordings, and with which data."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from gateway.settings import RECORDING_NAME


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StartRecordingRequest(_Request):
    """Begin to record."""

    name: str | None = Field(
        default=None,
        pattern=RECORDING_NAME,
        description="added to the file's name, which begins with the time",
    )


class StopRecordingRequest(_Request):
    """End the recording."""


class RecordingStatusRequest(_Request):
    """Whether and where is being recorded, and how it goes."""


REQUESTS: dict[str, type[BaseModel]] = {
    "start": StartRecordingRequest,
    "stop": StopRecordingRequest,
    "status": RecordingStatusRequest,
}
"""Verb to the data it takes."""
