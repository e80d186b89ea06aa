"""Modules that stamp their rows on a clock of their own: synchronised, or made to begin together."""

from __future__ import annotations

from collections.abc import Sequence

from devices.emulators.bodies import FloatArray
from devices.emulators.recordings import FusedTrack, ModuleTrack
from devices.vendor_formats.sheets import FormatError
from devices.vendor_formats.xsens_text import add_tracks


def stamped_tracks(
    labels: Sequence[str], tables: Sequence[tuple[FloatArray, FloatArray]], align: str
) -> tuple[list[ModuleTrack], list[FusedTrack]]:
    """Return the modules' tracks by number: raw readings, and orientations.

    tables: of each its stamps (n,), s, and rows as ``add_tracks`` wants them; align: ``stamps`` or ``start``.
    Raises ``FormatError``, also when stamps that are to agree do not overlap.
    """
    zero = min(times[0] for times, _ in tables)
    end = min(times[-1] for times, _ in tables)
    if align == "stamps" and any(times[0] >= end for times, _ in tables):
        raise FormatError(
            "the modules' time stamps do not overlap: they were not synchronised; --align start lets "
            "all begin together"
        )
    modules: list[ModuleTrack] = []
    fused: list[FusedTrack] = []
    for module, (label, (times, rows)) in enumerate(zip(labels, tables, strict=True)):
        # Without synchronisation the stamps of different modules have nothing in common.
        begin = times[0] if align == "start" else zero
        add_tracks(module, label, times - begin, rows, modules, fused)
    return modules, fused
