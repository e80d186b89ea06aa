"""Placeholder."""

from benchmarks.figures import Report


def run() -> Report:
    return Report("accuracy")
