"""What the doctor finds of a gateway from within: nothing is opened a second time, nobody is asked anew."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from devices.link import SUIT, Link
from devices.links.reconnect import LinkState, ReconnectingLink
from devices.links.serial_ports import serial_ports
from gateway.doctor import running
from gateway.doctor.examination import disk, kernels, metrics_port
from gateway.doctor.findings import Finding, Surroundings, bad, good, warning
from gateway.doctor.links import can_interface, capacity, device_of, latency, naming
from gateway.service.service import Service
from gateway.sources.link_settings import LinkSettings

_CAN = "280"
"""Type of network interface."""


async def examined(service: Service, here: Surroundings | None = None) -> dict[str, Any]:
    """Answer of ``gateway/examine``: findings, the ports of this computer with the link that uses each, and
    the links that are not up.

    Reading what the system says of ports and disks may take a while: poses go on meanwhile.
    """
    surroundings = here or Surroundings()
    states = {state.module: state for state in service.observer.figures().modules}
    found = list(running.judge(service.settings.gateway, states))
    # In threads: reading the system's files may block.
    ports = await asyncio.to_thread(ports_of, service.settings.links, surroundings)
    looked = await asyncio.to_thread(lambda: list(_examine(service, surroundings)))
    unused = [port["name"] for port in ports if port["link"] is None]
    if unused:
        named = ", ".join(str(name) for name in unused)
        found.append(
            warning("ports", f"no link uses {named}", "if a receiver is there, add it to 'links' (- url: …)")
        )
    down = [
        link.name
        for link in service.links
        if isinstance(link, ReconnectingLink) and link.state is not LinkState.UP
    ]
    findings = [asdict(finding) for finding in (*looked, *found)]
    return {"findings": findings, "ports": ports, "links_down": down}


def ports_of(links: list[LinkSettings], here: Surroundings) -> list[dict[str, str | None]]:
    """Return serial ports and CAN interfaces that are there, and the name of the link that uses each."""
    # Names under /dev/serial/by-id are links: both are compared as what they lead to.
    users = {str(Path(device).resolve()): link.name for link in links if (device := device_of(link.url))}
    found: list[dict[str, str | None]] = [
        {"name": port, "link": users.get(str(Path(port).resolve()))} for port in serial_ports()
    ]
    # The interface's type distinguishes CAN from Ethernet.
    for kind in sorted((here.sysfs / "class" / "net").glob("*/type")):
        if kind.read_text().strip() == _CAN:
            name = kind.parent.name
            user = next((link.name for link in links if link.url.startswith(f"can://socketcan/{name}")), None)
            found.append({"name": name, "link": user})
    return found


def _examine(service: Service, here: Surroundings) -> Iterator[Finding]:
    settings, suit = service.settings, service.pipeline.suit
    yield good("rig", f"{len(suit.module_ids)} modules on body '{suit.skeleton.name}'")
    yield from kernels(settings.reconstructor)
    links = {link.name: link for link in service.links}
    for link in settings.links:
        if (opened := links.get(link.name)) is not None:
            yield _port(link, opened)
        yield from naming(link, here)
        yield from latency(link, here)
        yield from can_interface(link, here)
        if link.carries == SUIT:
            yield from capacity(link.name, link.url, len(suit.module_ids), settings.assembly.rate_hz)
    yield disk(settings.recording, here)
    yield from metrics_port(settings.metrics, gateway_runs=True)


def _port(settings: LinkSettings, link: Link) -> Finding:
    """Return whether a link is open now."""
    subject = f"{settings.name}: port"
    if not isinstance(link, ReconnectingLink) or link.state is LinkState.UP:
        return good(subject, f"{settings.url} is open")
    found, _, remedy = (link.status.reason or f"{settings.url} is not open yet").partition("; ")
    return bad(subject, found, remedy or "plug it in, or correct its url in the configuration")
