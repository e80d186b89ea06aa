"""Fixtures of all tests, by subject, and waiting for a condition."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import hypothesis
import pytest

from tests.patience import PATIENCE_S

pytest_plugins = (
    "tests.fixtures.processes",  # first: others import it
    "tests.fixtures.kernels",
    "tests.fixtures.slow_marks",
    "tests.fixtures.brokers",
    "tests.fixtures.clusters",
    "tests.fixtures.poses",
    "tests.fixtures.recordings",
    "tests.fixtures.suits",
    "tests.fixtures.browsers",
    "tests.fixtures.commands",
)

hypothesis.settings.register_profile("busy machine", deadline=None)  # an example may wait its turn for long
hypothesis.settings.load_profile("busy machine")


async def _until(condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
    async with asyncio.timeout(timeout_s):
        while not condition():
            await asyncio.sleep(0.005)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what draws a page: see the Makefile."""
    for item in items:
        if "chromium" in getattr(item, "fixturenames", ()):
            item.add_marker("browser")


@pytest.fixture
def until() -> Callable[..., Awaitable[None]]:
    """``await until(condition, timeout_s=PATIENCE_S)``: polls; raises ``TimeoutError``."""
    return _until
