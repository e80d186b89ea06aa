"""All rules in order on one module."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Collection

from devices.conformance.bench import Bench
from devices.conformance.commanding import COMMANDING
from devices.conformance.rule import BrokenError, Rule, RuleOutcome, RuleResult, SkippedError
from devices.conformance.streaming import LISTENED_S, STREAMING
from devices.conformance.timing import TIMING
from devices.conformance.writing import WRITING, backup, held, write
from devices.link import Link, LinkError

RULES: tuple[Rule, ...] = (*STREAMING, *TIMING, *COMMANDING, *WRITING)
"""In the order in which they are tested."""


async def check_module(
    link: Link, device: str | None = None, *, allow_writes: bool = False, only: Collection[str] = ()
) -> AsyncIterator[RuleResult]:
    """Yield what came of each rule, for the module at the other end of a link that is not open yet.

    device: its id or the beginning of its unique id; None: the only one there.
    allow_writes: test what changes settings too; those of before are put back, whatever happens.
    only: names of rules; empty: all.
    Raises ``NoModuleError`` and ``LinkError``.
    """
    bench = Bench(link)
    async with bench.reading():
        await bench.find(device)
        wanted = [rule for rule in RULES if not only or rule.name in only]
        # Rules about samples look at what has come: they need something to look at.
        if any(rule in STREAMING for rule in wanted):
            await asyncio.sleep(LISTENED_S)
        kept = await backup(bench) if allow_writes else {}
        try:
            for rule in wanted:
                yield await _finding(bench, rule, allow_writes)
        finally:
            # Only what differs is written back.
            changed = {name: raw for name, raw in kept.items() if await held(bench, name) != raw}
            if changed:
                await write(bench, changed)


async def _finding(bench: Bench, rule: Rule, allow_writes: bool) -> RuleResult:
    if rule.is_writing and not allow_writes:
        return RuleResult(
            rule.name, rule.statement, RuleOutcome.SKIPPED, "it changes settings: pass --allow-writes"
        )
    if bench.is_lost is not None:
        raise LinkError(bench.is_lost)
    try:
        await rule.check(bench)
    except BrokenError as error:
        return RuleResult(rule.name, rule.statement, RuleOutcome.BROKEN, str(error))
    except SkippedError as error:
        return RuleResult(rule.name, rule.statement, RuleOutcome.SKIPPED, str(error))
    return RuleResult(rule.name, rule.statement, RuleOutcome.KEPT, "")
