"""Devices that announce themselves in the network, and the lines that a configuration needs for them."""

from __future__ import annotations

import asyncio
import re
from collections import Counter
from collections.abc import Sequence

from devices.links.udp_link import UdpLink
from gateway.sources.makers import Announced, Discovery
from gateway.sources.registry import SOURCES

EVERYWHERE = "0.0.0.0"
_MOST_DEVICES = 256


async def discovered(seconds: float, host: str = EVERYWHERE) -> list[Announced]:
    """Return the devices that announce themselves within a time, by kind and name.

    host: address of this computer to listen on. Raises ``LinkError`` where a port cannot be listened on.
    """
    found: dict[tuple[str, str], Announced] = {}
    tasks = [
        asyncio.create_task(_listen(UdpLink(host, kind.discovery.port), kind.discovery, found))
        for kind in SOURCES.values()
        if kind.discovery is not None
    ]
    # A port that cannot be listened on is known at once; announcements are waited for until the end.
    done, waiting = await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_EXCEPTION)
    for task in waiting:
        task.cancel()
    await asyncio.gather(*waiting, return_exceptions=True)
    for task in done:
        task.result()
    return _renamed(sorted(found.values(), key=lambda each: (each.carries, each.name, each.unique_id)))


def _renamed(found: Sequence[Announced]) -> list[Announced]:
    """Add their numbers to names that several have, as from the factory: links need names of their own."""
    names = Counter(each.name for each in found if each.entry is None)
    return [
        each._replace(name=f"{each.name} {each.unique_id}") if names[each.name] > 1 else each
        for each in found
    ]


def by_link(found: Sequence[Announced]) -> list[list[Announced]]:
    """Return devices together that share a link, each other one alone."""
    links: dict[tuple[str, ...], list[Announced]] = {}
    for each in found:
        alone = () if each.entry is not None else (each.unique_id,)
        links.setdefault((each.carries, each.url, *alone), []).append(each)
    return list(links.values())


def link_line(announced: Announced, *others: Announced) -> str:
    """Return the line of a configuration's ``links`` for a device, or for those that share a link, with
    ``NUMBER`` in the place of a module's number in the rig."""
    if announced.entry is not None:
        found_modules = [each.entry[1] for each in (announced, *others) if each.entry is not None]
        listed = ", ".join(f'"{name}": NUMBER' for name in found_modules)
        head = f'name: {announced.name}, url: "{announced.url}", carries: {announced.carries}'
        return f"- {{{head}, {announced.entry[0]}: {{{listed}}}}}"
    # A device's name is what somebody typed: nothing of it may end the quotes around it.
    name = re.sub(r"[^\w .-]", "", announced.name).strip() or announced.unique_id
    more = "".join(f", {key}: {value}" for key, value in announced.more.items())
    return f'- {{name: "{name}", url: "{announced.url}", carries: {announced.carries}, module: NUMBER{more}}}'


async def _listen(link: UdpLink, discovery: Discovery, found: dict[tuple[str, str], Announced]) -> None:
    await link.open()
    try:
        async for chunk in link:
            announced = discovery.read(chunk.data)
            if announced is not None and len(found) < _MOST_DEVICES:
                found[announced.carries, announced.unique_id] = announced
    finally:
        await link.close()
