"""A gateway, started by its command, that reads an emulated suit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

GATEWAY = "lab"


def suit_config(folder: Path, broker_port: int, rig: str, **settings: object) -> Path:
    """Write the configuration of a gateway that reads ``suit`` in a folder; return its file."""
    config = folder / "gateway.yaml"
    plain = {
        "gateway": GATEWAY,
        "links": [{"name": "suit", "url": str(folder / "suit")}],
        "rig": rig,
        "reconstructor": "independent",
        "mqtt": {"port": broker_port},
    }
    config.write_text(yaml.safe_dump(plain | settings))
    return config


async def started(
    command: Callable[..., Any],
    folder: Path,
    broker_port: int,
    rig: str,
    *emulated: str,
    **settings: object,
) -> Any:
    """Start the suit, on a pseudo-terminal, and the gateway; return the gateway.

    emulated: further words for ``emulate``. settings: further ones of the gateway.
    """
    place = ["--on", "pty", "--json", "--link", folder / "suit"]
    suit = command("emulate", "--rig", rig, *emulated, *place)
    await suit.until_it_says('"url"')
    return command("run", "-c", suit_config(folder, broker_port, rig, **settings))
