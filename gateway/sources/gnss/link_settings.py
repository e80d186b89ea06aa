"""What the configuration says of a link to a satellite receiver."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from gateway.sources.link_settings import LinkSettings


class GnssLinkSettings(LinkSettings):
    """A satellite receiver."""

    carries: Literal["gnss"] = "gnss"
    device: int = Field(
        default=60, ge=0, le=63, description="for gnss: id under which the rig's local device knows it"
    )
    latency_ms: float = Field(
        default=50,
        ge=0,
        le=5000,
        description="for gnss: from the instant of a fix to its arrival, at the least",
    )
    origin: tuple[float, float, float] | None = Field(
        default=None,
        description="for gnss: latitude and longitude in degrees and height above the ellipsoid in metres of "
        "the world's origin; none: the first fix",
    )

    @model_validator(mode="after")
    def _is_on_earth(self) -> GnssLinkSettings:
        if self.origin is not None and not (abs(self.origin[0]) <= 90 and abs(self.origin[1]) <= 180):
            raise ValueError("origin: latitude within ±90 and longitude within ±180 degrees are wanted")
        return self
