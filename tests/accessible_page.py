"""A page held against the rules of axe-core."""

from __future__ import annotations

from importlib import resources
from typing import Any

import pytest

pytest.importorskip("axe_playwright_python", reason="axe-playwright-python is not installed")

AXE = (resources.files("axe_playwright_python") / "axe.min.js").read_text(encoding="utf-8")
GRAVE = {"serious", "critical"}
LIBRARY = "'.mantine-Notification-root', '.mantine-ActionIcon-root'"
"""What the page's library adds by itself, whose buttons have no names: its remark that there is no graphics
processor, and the panel's settings."""
RUN = f"axe.run({{exclude: [{LIBRARY}]}}, {{resultTypes: ['violations']}})"


async def grave_findings(page: Any, where: str) -> list[str]:
    """What breaks a rule gravely as the page is now, a line each. where: what they are told with."""
    await page.evaluate(AXE)
    return [
        f"{where}: {one['id']}: {node['html'][:160]} {node['failureSummary']}"
        for one in (await page.evaluate(RUN))["violations"]
        if one["impact"] in GRAVE
        for node in one["nodes"]
    ]
