"""How good a calibration is, and what is wrong with it, in words for the user."""

from __future__ import annotations

from dataclasses import dataclass

GOOD, FAIR = 0.7, 0.4
"""Scores from which on a calibration counts as good, and as fair."""


@dataclass(frozen=True)
class QualityAspect:
    """One thing that was looked at."""

    score: float
    """1: as good as it can be; 0: useless."""
    reason: str
    """What is wrong and what would do, for when the score is below ``GOOD``."""


@dataclass(frozen=True)
class Quality:
    """The worst finding is what counts."""

    score: float
    """0 to 1."""
    reasons: tuple[str, ...] = ()
    """Of the findings that are not good, the worst first."""

    @property
    def verdict(self) -> str:
        """``good``, ``fair`` or ``poor``."""
        return "good" if self.score >= GOOD else "fair" if self.score >= FAIR else "poor"


def judged(*findings: QualityAspect) -> Quality:
    """Return the quality that findings add up to."""
    ordered = sorted(findings, key=lambda finding: finding.score)
    return Quality(ordered[0].score, tuple(f.reason for f in ordered if f.score < GOOD))


def graded(value: float, good: float, bad: float) -> float:
    """Return 1 at ``good/2`` (or twice it, if more is better), ``GOOD`` at ``good``, 0 at ``bad``."""
    if good < bad:
        best = 0.5 * good
        return _between(value, best, good, bad)
    return _between(-value, -min(2.0 * good, good + 0.5 * (good - bad)), -good, -bad)


def _between(value: float, best: float, good: float, bad: float) -> float:
    if not value < bad:  # NaN counts as bad
        return 0.0
    if value <= good:
        return min(1.0, 1.0 - (1.0 - GOOD) * (value - best) / (good - best))
    return GOOD * (bad - value) / (bad - good)
