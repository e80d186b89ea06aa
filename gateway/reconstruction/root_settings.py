"""Whether and where the body moves through the world, as configured."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

NO_CONTACTS = "body '{}' has no contacts to walk on: give its feet 'contacts', or set 'auto' or 'fixed'"


class RootMode(StrEnum):
    """What the skeleton's root does."""

    AUTO = "auto"
    """Walks if the body has contacts (feet) and no device measures where it is; else fixed."""
    FIXED = "fixed"
    """Stays at the origin, or where a local device measures it."""
    WALKING = "walking"
    """Stands on contacts at rest and flies between them."""


class RootSettings(NamedTuple):
    """How the body moves through the world."""

    mode: RootMode = RootMode.AUTO
    has_floor: bool = True
    floor: float = 0.0
    """m: height of a level floor."""
