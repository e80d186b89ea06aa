"""Parts of a service that a configuration and a suit alone decide."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence

import gateway
from devices.link import Link
from devices.links.reconnect import LinkStatus, kept_open
from gateway.body.skeleton import WornSuit
from gateway.cameras.broker_link import link_of
from gateway.contract.messages import BridgeInfo, KernelsInfo, ModuleInfo
from gateway.geometry import compiled
from gateway.service.host_sender import HostSender
from gateway.service.synchronisation import Synchroniser
from gateway.service.triggering import Triggerer
from gateway.settings import GatewaySettings
from gateway.sources.clock_mode import ClockMode
from gateway.sources.makers import OthersLinkSettings
from gateway.sources.suit import SuitSource
from gateway.support.processor import target_name


def links_of(
    settings: GatewaySettings, on_change: Callable[[str, LinkStatus], None], broker_port: Callable[[], int]
) -> list[Link]:
    """Return the links of the configuration, opened again whenever they are lost.

    on_change: called with a link's name and state. broker_port: of the broker, once it is known.
    """
    links = [link_of(link, settings.mqtt, broker_port) for link in settings.links]
    return [kept_open(link, functools.partial(on_change, link.name)) for link in links]


def unworn_modules(settings: GatewaySettings) -> set[int]:
    """Return the numbers that streams of whole bodies may bring although the rig has no such module."""
    streams = [link for link in settings.links if isinstance(link, OthersLinkSettings)]
    return {number for link in streams for number in {*link.modules} - {*link.own_numbers}}


def periodic_senders(
    settings: GatewaySettings, links: Sequence[Link], sender: HostSender, stream: SuitSource
) -> Iterator[Synchroniser | Triggerer]:
    """Yield what sends to all modules time and again: for their time, where clocks are estimated from it, and
    for samples, where the gateway says when to take them."""
    clock = settings.clock
    if clock.mode in {ClockMode.ESTIMATED, ClockMode.TRIGGER} and clock.sync_rate_hz:
        yield Synchroniser(links, sender, 1.0 / clock.sync_rate_hz)
    if (answers := stream.triggers) is not None:
        yield Triggerer(links, sender, answers, clock.trigger_rate_hz)


def bridge_info(settings: GatewaySettings, suit: WornSuit, awaited: str | None) -> BridgeInfo:
    """Return what the gateway publishes of itself. awaited: the method that is being compiled, if any."""
    ready, made = compiled.origins()
    worn = zip(suit.module_of_segment, suit.skeleton.segment_names, strict=True)
    return BridgeInfo(
        version=gateway.__version__,
        gateway=settings.gateway,
        reconstructor=settings.reconstructor,
        frame_rate=settings.assembly.rate_hz,
        modules=tuple(
            ModuleInfo(module=suit.module_ids[row], segment=segment) for row, segment in worn if row >= 0
        ),
        kernels=KernelsInfo(target=target_name(), ready=ready, compiled=made, awaited=awaited),
    )
