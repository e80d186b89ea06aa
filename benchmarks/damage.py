"""Suite ``damage``: what other makers' protocols let through of messages that were damaged on the way.

``python -m devices.emulators.faults.makers_campaign`` runs a protocol alone and says more of it. Every
message has values of its own, half of them are damaged, and a message counts as read wrongly where its values
were never sent.
"""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor

from benchmarks.figures import Figure, Report, table
from devices.emulators.faults.makers_campaign import LANGUAGES, MakersFindings
from devices.emulators.faults.makers_campaign import run as run_campaign

DAMAGED = 1_000_000
SEED = 1


def run() -> Report:
    """Run one campaign a protocol, two protocols at a time."""
    with ProcessPoolExecutor(os.cpu_count()) as processes:
        verdicts = dict(zip(LANGUAGES, processes.map(_campaign, LANGUAGES), strict=True))
    report = Report("damage")
    raised = sum(len(verdict.raised) for verdict in verdicts.values())
    lost = sum(len(verdict.lost) for verdict in verdicts.values())
    note = f"of {len(LANGUAGES)} × {DAMAGED} damaged messages among as many intact ones"
    report.figures = [
        Figure("damage_exceptions", raised, "", "<=0", f"exceptions of decoders, {note}"),
        Figure("damage_intact_lost", lost, "", "<=0", f"intact messages, after four others, lost; {note}"),
    ]
    heads = ["protocol", "damaged", "read wrongly, %", "of it most of", "there, %", "dropped most for"]
    report.tables = [table(heads, [[name, *_cells(verdict)] for name, verdict in verdicts.items()])]
    return report


def _campaign(name: str) -> MakersFindings:
    return run_campaign(LANGUAGES[name], DAMAGED, SEED)


def _cells(verdict: MakersFindings) -> list[str]:
    """Return the rates of a protocol, and the way of damage that it notices least."""
    shares = {way: verdict.corrupt[way] / count for way, count in verdict.damaged.items()}
    worst = max(shares, key=lambda way: shares[way])
    reasons = ", ".join(reason for reason, _ in verdict.dropped.most_common(3))
    return [
        str(verdict.damaged.total()),
        f"{100 * verdict.corrupt_share:.2f}",
        worst,
        f"{100 * shares[worst]:.1f}",
        reasons,
    ]
