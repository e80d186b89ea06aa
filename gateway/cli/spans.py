"""Stretches of time on the command line: ``FROM:TO``, seconds."""

from __future__ import annotations

import re

from gateway.errors import GatewayError


def seconds_of(option: str, text: str) -> tuple[float, float]:
    """From when to when, s. Raises ``GatewayError``, which names the option."""
    span = re.fullmatch(r"(\d+\.?\d*):(\d+\.?\d*)", text)
    if span is None or float(span[1]) >= float(span[2]):
        raise GatewayError(f"{option} {text}: seconds FROM:TO are wanted, such as 0.5:3")
    return float(span[1]), float(span[2])
