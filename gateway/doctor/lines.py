"""Whether a serial line or CAN bus carries what the suit sends."""

from __future__ import annotations

from collections.abc import Iterator

from devices.line_rate import CanRate, UartRate, line_rate
from firmware_protocol import InertialSample
from firmware_protocol.capacity import Traffic, can_load, uart_load
from gateway.doctor.findings import Finding, Verdict, good

COMFORTABLE = 0.7
"""Share of a line above which bursts, retries and commands begin to wait."""
_FULL_SAMPLE = InertialSample((0.0, 0.0, 9.8), (20.0, 0.0, -40.0), (0.0, 0.0, 0.0))


def capacity(name: str, url: str, n_modules: int, rate_hz: float) -> Iterator[Finding]:
    """Whether the link's line carries so many modules (accelerometer, magnetometer and gyrometer each)."""
    rate = line_rate(url)
    if rate is None:
        return
    traffic = [Traffic(_FULL_SAMPLE, n_modules, rate_hz)]
    if isinstance(rate, CanRate):
        load = can_load(traffic, rate.bitrate, rate.data_bitrate)
        line = f"CAN at {rate.bitrate:,} bit/s" + (f", FD {rate.data_bitrate:,}" if rate.data_bitrate else "")
        remedy = (
            "use CAN FD (fd=1), a higher bitrate, a second bus"
            if rate.data_bitrate is None
            else "a second bus"
        )
    else:
        load = uart_load(traffic, rate.baud)
        line = f"serial at {rate.baud:,} baud"
        remedy = _uart_remedy(traffic, rate)
    found = f"{n_modules} modules × {rate_hz:g} Hz take {load:.0%} of {line}"
    if load <= COMFORTABLE:
        yield good(f"{name}: capacity", found)
        return
    verdict = Verdict.BAD if load > 1 else Verdict.WARNING
    yield Finding(
        f"{name}: capacity", verdict, found, f"{remedy}, or at most {rate_hz * COMFORTABLE / load:.0f} Hz"
    )


def _uart_remedy(traffic: list[Traffic], rate: UartRate) -> str:
    with_relay = uart_load(traffic, rate.baud, has_relay=True)
    needed = uart_load(traffic, 1) / COMFORTABLE
    return f"at least {needed:,.0f} baud, a relay that batches ({with_relay:.0%})"
