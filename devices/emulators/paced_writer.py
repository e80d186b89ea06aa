"""A suit reduced to its wire: writes prepared bytes to a pseudo-terminal, each at its time.

Run as a process of its own, so that its work does not count as the gateway's:
``python -m devices.emulators.paced_writer LINK N_MODULES RATE_HZ SECONDS``. Prints one JSON line when the
port is there, and one with the gateway time of the last byte of every tick at the end.
"""

from __future__ import annotations

import json
import os
import sys
import time
import tty
from pathlib import Path

from devices.link import gateway_time_ns
from firmware_protocol import InertialSample, WireFrame, encode_frame, relay_batch, wire_frame

LEAD_S = 0.3


def ticks(n_modules: int, rate_hz: float, seconds: float) -> list[bytes]:
    """Return one relay batch a tick: all modules sampled at the same instant."""
    sample = InertialSample((0.1, 0.2, 9.8), (20.0, 1.0, -40.0), (0.01, 0.02, -0.03))
    result = []
    for k in range(round(seconds * rate_hz)):
        time_us = round(k * 1e6 / rate_hz)
        frames: list[WireFrame] = [
            wire_frame(sample, module, k % 65536, time_us) for module in range(n_modules)
        ]
        result.append(encode_frame(relay_batch(frames, k % 65536, time_us)))
    return result


def main() -> None:
    """Write everything on time; a reader that is late gets it late, nothing is dropped."""
    path, n_modules, rate_hz, seconds = (
        Path(sys.argv[1]),
        int(sys.argv[2]),
        float(sys.argv[3]),
        float(sys.argv[4]),
    )
    data = ticks(n_modules, rate_hz, seconds)
    master, slave = os.openpty()
    tty.setraw(slave)
    path.symlink_to(os.ttyname(slave))
    print(json.dumps({"ready": str(path)}), flush=True)
    sys.stdin.readline()  # the gateway has opened the port
    start = time.monotonic() + LEAD_S
    written_ns = []
    for k, tick in enumerate(data):
        delay = start + k / rate_hz - time.monotonic()
        if delay > 0:
            time.sleep(delay)
        rest = tick
        while rest:
            rest = rest[os.write(master, rest) :]
        written_ns.append(gateway_time_ns())
    print(json.dumps({"written_ns": written_ns}), flush=True)
    sys.stdin.readline()
    path.unlink()


if __name__ == "__main__":
    main()
