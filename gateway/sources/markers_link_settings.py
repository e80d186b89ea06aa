"""What the configuration says of a link to an optical system."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from gateway.sources.link_settings import LinkSettings


class MarkersLinkSettings(LinkSettings):
    """An optical system that names markers."""

    carries: Literal["markers"] = "markers"
    person: str | None = Field(
        default=None,
        min_length=1,
        description="for markers: whose, where several people come (NAME:LASI); none: its own, by "
        "the name before the labels of its file, else those of the only person there is",
    )
