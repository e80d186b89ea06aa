"""A device's settings: those it acts by, those staged, and where they are kept. Sans-I/O."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from firmware_protocol.device_settings import SETTINGS, factory_settings
from firmware_protocol.flash_slots import Flash, FlashError, SlotStore

KEYS = {setting.name: key for key, setting in SETTINGS.items()}
"""Of settings, by name."""


class StoredSettings:
    """Settings by name to act by, and by key for commands.

    A new one of the same flash is what a device has after a loss of power: whatever was staged is gone.
    """

    def __init__(self, flash: Flash) -> None:
        self._store = SlotStore(flash)
        self._active = self._store.load()
        self.staged: dict[int, Any] = {}
        """Values written and not yet committed, by key."""

    @property
    def is_factory(self) -> bool:
        """No settings were ever committed, or none of them can be read."""
        return self._store.generation is None

    def __getitem__(self, name: str) -> Any:
        """Return the value acted by. Raises ``KeyError`` for a name that is no setting's."""
        return self._active[KEYS[name]]

    def value(self, key: int) -> Any:
        """Return what a host reads: the staged value if there is one, else the one acted by."""
        return self.staged.get(key, self._active[key])

    def stage(self, key: int, value: Any) -> None:
        """Keep a value for the next commit."""
        self.staged[key] = value

    def discard(self) -> None:
        """Forget what is staged."""
        self.staged.clear()

    def commit(self) -> int | None:
        """Store what is staged and act by it; the new generation, or None when the flash failed.

        Raises ``PowerLost`` when the flash says so.
        """
        return self._keep({**self._active, **self.staged})

    def reset(self) -> int | None:
        """Store the factory settings and act by them; otherwise as ``commit``."""
        return self._keep(factory_settings())

    def _keep(self, settings: dict[int, Any]) -> int | None:
        try:
            generation = self._store.commit(settings)
        except FlashError:
            return None
        self._active = settings
        self.staged.clear()
        return generation


def provision(flash: Flash, values: Mapping[str, Any]) -> None:
    """Store settings by name, and the factory values of all others, as whoever delivers a suit does."""
    SlotStore(flash).commit(factory_settings() | {KEYS[name]: value for name, value in values.items()})
