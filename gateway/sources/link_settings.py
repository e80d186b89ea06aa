"""What the configuration says of one link. The source of another maker's modules extends this where it is."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from devices.link import SUIT
from gateway.support.settings_files import Strict

_CARRIED = {"qtm": "markers", "markers": "markers", "mqtt": "heat_maps"}
"""What links of some schemes carry, and nothing else."""


def has_credentials(url: object) -> bool:
    """Return whether a URL names a user, or a password."""
    return isinstance(url, str) and "@" in url.partition("://")[2].partition("/")[0]


class LinkSettings(Strict):
    """One serial port, CAN bus, socket or recording."""

    name: str = Field(min_length=1, max_length=100, description="short name for logs and statistics")
    url: str = Field(
        min_length=1,
        description="where the suit is: /dev/serial/by-id/…?baud=…, slcan:///dev/ttyACM0?bitrate=1000000, "
        "can://socketcan/can0, tcp://host:port, udp://host:port (signed: ?key_file=…), qtm://host, "
        "markers:///path/walk.c3d, recording:///path/to/file.mcap; of heat maps also mqtt:///topic, at the "
        "broker of section mqtt",
    )
    carries: str = Field(
        default=SUIT,
        description="suit: packets of modules; the word of another maker's modules, such as ximu3; "
        "gnss: NMEA 0183 or UBX of a satellite receiver; "
        "markers: messages of an optical system; heat_maps: those of `mocap-gateway video serve-camera`",
    )

    @model_validator(mode="before")
    @classmethod
    def _has_no_credentials(cls, given: Any) -> Any:
        if isinstance(given, dict) and has_credentials(given.get("url")):
            # Raised without the value: it would stand in the message otherwise.
            del given["url"]
            raise ValueError("url: a link takes no user name or password: leave out what stands before the @")
        return given

    @model_validator(mode="before")
    @classmethod
    def _carries_what_its_scheme_has(cls, given: Any) -> Any:
        """Fill in what a scheme can carry alone, where nothing is said."""
        if not isinstance(given, dict) or not isinstance(given.get("url"), str):
            return given
        scheme = given["url"].partition("://")[0]
        if scheme in _CARRIED and given.get("carries", SUIT) == SUIT:
            return {**given, "carries": _CARRIED[scheme]}
        return given

    @model_validator(mode="after")
    def _carries_what_it_can(self) -> LinkSettings:
        scheme = self.url.partition("://")[0]
        wanted = _CARRIED.get(scheme, self.carries)
        if self.carries != wanted:
            raise ValueError(f"carries: {scheme}:// carries {wanted} and nothing else: leave 'carries' out")
        if "key_file=" in self.url and self.carries != SUIT:
            raise ValueError("url: key_file is for links of modules: nothing else is signed")
        return self


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


class MarkersLinkSettings(LinkSettings):
    """An optical system that names markers."""

    carries: Literal["markers"] = "markers"
    person: str | None = Field(
        default=None,
        min_length=1,
        description="for markers: whose, where several people come (NAME:LASI); none: its own, by "
        "the name before the labels of its file, else those of the only person there is",
    )
