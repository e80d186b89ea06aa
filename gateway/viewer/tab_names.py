"""Another name for a tab that is there: the library has no public way to it."""

from __future__ import annotations

import viser


def rename(tabs: viser.GuiTabGroupHandle, tab: viser.GuiTabHandle, name: str) -> None:
    """Call a tab of the group so from now on, on all pages."""
    tab._label = name
    tabs._tab_labels = tuple(each._label for each in tabs._tab_handles)
