"""Emulated modules that speak as another maker's: their emulators, and what to write into a configuration."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import typer
import yaml

from devices.emulators.device.sampling import FUSED
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.makers.registry import VENDOR_EMULATORS
from devices.emulators.makers.vendor_emulator import VendorEmulator
from devices.emulators.suit_traffic import SuitTraffic
from gateway.body.skeleton import WornSuit
from gateway.errors import GatewayError


@dataclass(frozen=True)
class VendorSuit:
    """A suit whose modules speak as another maker's."""

    carries: str
    rig: str
    emulators: Mapping[int, VendorEmulator]
    segments: Mapping[int, str]
    is_fused: bool

    @property
    def method(self) -> str | None:
        """The reconstructor that takes what they send; None: the usual one."""
        if not self.is_fused:
            return None
        return "fused" if next(iter(self.emulators.values())).sends_as_one else "fused_neutral"


def vendor_suit_of(traffic: SuitTraffic | None, speaks: str | None, rig: str) -> VendorSuit | None:
    """Return a suit that speaks as another maker's; None: it speaks our packets, or only plays."""
    if speaks is None or traffic is None:
        return None
    body = traffic.motion.body
    worn = zip(body.module_ids.tolist(), map(str, body.segment_names), strict=True)
    return VendorSuit(speaks, rig, traffic.emulators, dict(worn), traffic.settings.mode == FUSED)


def emulators_of(speaks: str, suit: WornSuit) -> Callable[[int], VendorEmulator]:
    """Return the emulators of a suit's modules, by number. Raises ``GatewayError`` for numbers that no device
    of the maker has."""
    from gateway.modules.summary import segments_of

    field_ut = float(np.linalg.norm(suit.magnetic_field))
    try:
        return VENDOR_EMULATORS[speaks](list(segments_of(suit).values()), field_ut).__getitem__
    except ValueError as error:
        raise GatewayError(f"--speaks {speaks}: {error}") from None


def print_links(urls: Mapping[int, str], suit: EmulatedSuit, vendor: VendorSuit, as_json: bool) -> None:
    """Say where each module speaks, as the lines that the configuration of a gateway needs."""
    links = _links(urls, vendor)
    if as_json:
        typer.echo(json.dumps({"links": links, "start_ns": suit.start_ns}))
        return
    typer.echo(f"# emulated modules that speak {vendor.carries} (Ctrl-C ends them); for the configuration:")
    typer.echo(f"rig: {vendor.rig}")
    if vendor.method is not None:
        typer.echo(f"reconstructor: {vendor.method}")
    typer.echo("links:")
    for link in links:
        typer.echo(
            "  - " + yaml.safe_dump(link, default_flow_style=True, sort_keys=False, width=1000).strip()
        )


def _links(urls: Mapping[int, str], vendor: VendorSuit) -> list[dict[str, object]]:
    """Return a link a device; of those that share one, one with what distinguishes them."""
    if not any(emulator.shares_link for emulator in vendor.emulators.values()):
        return [_link(module, url, vendor) for module, url in urls.items()]
    names_of: dict[str, dict[str, object]] = {}
    for emulator in vendor.emulators.values():
        for key, names in emulator.link_settings.items():
            assert isinstance(names, Mapping)
            names_of.setdefault(key, {}).update(names)
    return [{"name": vendor.carries, "url": next(iter(urls.values())), "carries": vendor.carries, **names_of}]


def _link(module: int, url: str, vendor: VendorSuit) -> dict[str, object]:
    name = vendor.segments.get(module, str(module))
    usual = {"name": name, "url": url, "carries": vendor.carries, "module": module}
    if vendor.emulators[module].sends_as_one:
        usual |= {"name": vendor.carries, "module": 0}
    return {**usual, **vendor.emulators[module].link_settings}
