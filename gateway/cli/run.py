"""``mocap-gateway run``: the service."""

from __future__ import annotations

import asyncio
import logging
import signal
from pathlib import Path

import typer

from gateway.body.rig import load_rig
from gateway.service import Service
from gateway.settings import load_gateway_settings


def run(
    config: Path = typer.Option(
        Path("config/gateway.yaml"), "--config", "-c", help="Configuration file (see `config schema`)."
    ),
) -> None:
    """Read the suit, reconstruct, publish. Ends on Ctrl-C or SIGTERM.

    A link that is absent is waited for; a broker that is away is tried again and again.
    """
    settings = load_gateway_settings(config)
    suit = load_rig(settings.rig, config)
    logging.getLogger().setLevel(settings.log.level.upper())
    service = Service(settings, suit)
    logging.getLogger(__name__).info(
        "gateway '%s': %d modules on '%s', links %s",
        settings.gateway,
        len(suit.module_ids),
        suit.skeleton.name,
        ", ".join(f"{link.name} ({link.url})" for link in settings.links),
    )
    asyncio.run(until_signal(service))


async def until_signal(service: Service) -> None:
    """Run a service until it ends, or SIGINT or SIGTERM comes."""
    task = asyncio.ensure_future(service.run())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    try:
        await task
    except asyncio.CancelledError:
        logging.getLogger(__name__).info("stopped")
