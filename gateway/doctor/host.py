"""This computer: room for recordings, and ports that the gateway will listen on."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

from gateway.doctor.findings import Finding, Surroundings, bad, good, warning
from gateway.settings import MetricsSettings, RecordingSettings

_MB = 1e6


def disk(settings: RecordingSettings, surroundings: Surroundings) -> Finding:
    """Whether there is room where recordings go."""
    folder = Path(settings.folder).absolute()
    present = next(each for each in (folder, *folder.parents) if each.exists())
    if not present.is_dir() or not os.access(present, os.W_OK | os.X_OK):
        found = f"{present} cannot be written by this user"
        return bad("disk", found, f"sudo chown $USER {present}, or another recording.folder")
    free_mb = surroundings.free_bytes(present) / _MB
    found = f"{free_mb:,.0f} MB free for recordings in {folder}"
    remedy = "delete or move recordings, or choose another recording.folder"
    if free_mb < settings.min_free_mb:
        least = f"recording stops below {settings.min_free_mb:,.0f} MB (recording.min_free_mb)"
        return bad("disk", f"{found}: {least}", remedy)
    if free_mb < settings.warn_free_mb:
        return warning("disk", found, remedy)
    return good("disk", found)


def metrics_port(settings: MetricsSettings, *, gateway_runs: bool) -> Iterator[Finding]:
    """Whether the port of the metrics is free, or taken by the running gateway."""
    if not settings.port:
        return
    where = f"{settings.host}:{settings.port}"
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            if gateway_runs:
                yield good("metrics", f"{where} is taken, by the running gateway")
            else:
                remedy = "another metrics.port, or stop what listens there (ss -ltnp)"
                yield bad("metrics", f"{where} cannot be listened on ({error.strerror})", remedy)
            return
    yield good("metrics", f"{where} is free")
