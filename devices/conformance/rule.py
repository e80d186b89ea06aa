"""What a rule is, and how one fails."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from devices.conformance.bench import Bench


class RuleOutcome(StrEnum):
    """How the test of a rule ended."""

    KEPT = "kept"
    BROKEN = "broken"
    SKIPPED = "skipped"


class BrokenError(Exception):
    """The module does not keep the rule; says what it did."""


class SkippedError(Exception):
    """The rule does not apply here; says why."""


Check = Callable[[Bench], Awaitable[None]]


@dataclass(frozen=True)
class Rule:
    """One thing that a module must do."""

    name: str
    """Short, and never given a second meaning: people search for it."""
    statement: str
    """The rule, in the words of the reference."""
    check: Check
    """Raises ``BrokenError`` or ``SkippedError``."""
    is_writing: bool = False
    """It changes settings, which are put back in the end."""


class RuleResult(NamedTuple):
    """What came of one rule."""

    rule: str
    statement: str
    outcome: RuleOutcome
    detail: str


def rule(name: str, statement: str, *, is_writing: bool = False) -> Callable[[Check], Rule]:
    """Make a rule of a check."""

    def made(check: Check) -> Rule:
        return Rule(name, statement, check, is_writing)

    return made


def demand(condition: object, found: str) -> None:
    """Raise ``BrokenError`` unless the condition holds; found: what the module did."""
    if not condition:
        raise BrokenError(found)
