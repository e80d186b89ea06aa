"""What can go wrong for the user's own doing, and who must act.

    GatewayError                 one line: what was found, and what would do
    ├── SettingsError            a configuration, rig or body file is wrong
    └── OutputError              an output could not be started

A link that cannot be opened raises ``devices.link.LinkError``. Bytes from the wire never raise:
they are dropped and counted.
"""

from __future__ import annotations

from devices.known_names import nearest

__all__ = ["GatewayError", "OutputError", "SettingsError", "nearest"]


class GatewayError(Exception):
    """Something the user can put right; ``str(error)`` says how."""


class SettingsError(GatewayError):
    """A configuration, rig or body file is wrong."""


class OutputError(GatewayError):
    """An output could not be started."""
