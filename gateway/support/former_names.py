"""Words of files and requests that were others in the release before: they are read still, with a warning."""

from __future__ import annotations

import logging
import re
from functools import cache
from typing import Any

log = logging.getLogger(__name__)

FORMER = {"gyrometer": "gyroscope"}
"""Former word to today's, alone or as the beginning of a name such as ``gyrometer_bias``."""
_NAME = re.compile(rf"({'|'.join(FORMER)})(s?(_[a-z_]*)?)$")


def current(content: Any) -> Any:
    """Return what a file or request holds with today's words: as keys, and as whole texts within lists."""
    if isinstance(content, dict):
        return {_today(key): current(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_today(item) if isinstance(item, str) else current(item) for item in content]
    return content


def _today(name: Any) -> Any:
    found = _NAME.match(name) if isinstance(name, str) else None
    if found is None:
        return name
    today = FORMER[found[1]] + found[2]
    _warn(name, today)
    return today


@cache
def _warn(former: str, today: str) -> None:
    """Warn once of each."""
    log.warning("'%s' is called '%s' now: the next release will not read the former name", former, today)
