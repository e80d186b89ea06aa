"""What can go wrong for the user's own doing, and who must act.

    GatewayError                 one line: what was found, and what would do
    ├── SettingsError            a configuration, rig or body file is wrong
    └── OutputError              an output could not be started

A link that cannot be opened raises ``devices.link.LinkError``. Bytes from the wire never raise:
they are dropped and counted.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class GatewayError(Exception):
    """Something the user can put right; ``str(error)`` says how."""


class SettingsError(GatewayError):
    """A configuration, rig or body file is wrong."""


class OutputError(GatewayError):
    """An output could not be started."""


def nearest(name: str, known: Iterable[str]) -> str:
    """`` (did you mean 'x'?)`` for the most similar known name, or the list of all when none is near."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else f" (known: {', '.join(names)})"
