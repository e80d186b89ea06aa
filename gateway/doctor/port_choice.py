"""Has a link use another port of this computer: its url in the configuration file changes."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from devices.links.reconnect import LinkState, ReconnectingLink
from gateway.contract.requests import ConnectRequest
from gateway.doctor.findings import Surroundings
from gateway.doctor.inside import ports_of
from gateway.errors import GatewayError, nearest
from gateway.service.service import Service
from gateway.sources.link_settings import LinkSettings
from gateway.support import yaml_text
from gateway.support.whole_files import write_whole, writing

_ADAPTER = "slcan"
"""Scheme of adapters that are serial ports; CAN frames go over them as text."""
_BUS = "can"


class PortChoice:
    """Obeys ``gateway/connect``; belongs to one running service and the file that describes it."""

    def __init__(
        self,
        config: Path,
        service: Service,
        read_anew: Callable[[], Awaitable[None]],
        here: Surroundings | None = None,
    ) -> None:
        """Change the url in ``config``; ``read_anew`` restarts the service with it, or raises
        ``GatewayError``.
        """
        self._config, self._service, self._read_anew = config, service, read_anew
        self._here = here or Surroundings()

    async def connect(self, request: ConnectRequest) -> dict[str, Any]:
        """Write the port into the file and read it anew; return the link and its new url.

        Only ports that this computer has are taken, and only by a link that is not up. Raises
        ``GatewayError`` with what would do; the file is then as it was.
        """
        links: Sequence[LinkSettings] = self._service.settings.links
        place = self._place_of(request.link, links)
        self._refuse_used(request, links)
        url = url_of(request.port, links[place].url)
        # Kept byte for byte: comments and order of the user's file must survive a failure.
        before = self._config.read_bytes()
        text = yaml_text.replaced(before.decode("utf-8"), ("links", place, "url"), url)
        with writing(self._config):
            write_whole(self._config, text.encode("utf-8"))
        try:
            await self._read_anew()
        except GatewayError:
            with writing(self._config):
                write_whole(self._config, before)
            raise
        return {"link": request.link, "url": url}

    def _place_of(self, name: str, links: Sequence[LinkSettings]) -> int:
        """Return which link of the file it is. Raises ``GatewayError`` for none, and for one that is up."""
        names = [link.name for link in links]
        if name not in names:
            raise GatewayError(f"there is no link '{name}'{nearest(name, names)}")
        opened = {link.name: link for link in self._service.links}.get(name)
        if isinstance(opened, ReconnectingLink) and opened.state is LinkState.UP:
            raise GatewayError(f"link '{name}' is up at {links[names.index(name)].url}: unplug it first")
        return names.index(name)

    def _refuse_used(self, request: ConnectRequest, links: Sequence[LinkSettings]) -> None:
        users: Mapping[str | None, str | None] = {
            port["name"]: port["link"] for port in ports_of(list(links), self._here)
        }
        if request.port not in users:
            there = ", ".join(str(name) for name in users) or "none: plug the receiver in"
            raise GatewayError(f"this computer has no port '{request.port}'; there are: {there}")
        if users[request.port] not in (None, request.link):
            raise GatewayError(f"port {request.port} is used by link '{users[request.port]}'")


def url_of(port: str, before: str) -> str:
    """Return the endpoint of a port for a link that had another one; rates stay where they fit."""
    parts = urlsplit(before)
    if not port.startswith("/"):
        return f"{_BUS}://socketcan/{port}" + (f"?{parts.query}" if parts.scheme == _BUS else "")
    query = f"?{parts.query}" if parts.query and parts.scheme in ("", "serial", _ADAPTER) else ""
    return f"{_ADAPTER}://{port}{query}" if parts.scheme == _ADAPTER else port + query
