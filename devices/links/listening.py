"""What links that listen on a port of this computer share: who may send there, why a port is not given."""

from __future__ import annotations

import errno
import functools
import ipaddress
import logging
import socket
from collections.abc import Collection
from typing import Any

from devices.link import LinkBusyError, LinkError
from devices.links.link_counts import LinkCounts

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
Address = tuple[Any, ...]
"""As sockets give it: host, port and, for IPv6, flow and scope."""

_MOST_REFUSED_NAMED = 16


class Peers:
    """Who may send to a link; others are counted, and the first few are named in the log."""

    def __init__(
        self, link: str, networks: Collection[Network], counts: LinkCounts, log: logging.Logger, what: str
    ) -> None:
        """Admit addresses of ``networks``, or any if empty; ``what`` becomes of others, for the log."""
        self.networks = tuple(networks)
        self._link, self._counts, self._log, self._what = link, counts, log, what
        self._refused_hosts: set[str] = set()

    def admits(self, host: str) -> bool:
        """Return whether an address may send; count one that may not."""
        if not self.networks or _is_in(host, self.networks):
            return True
        self._counts.refused += 1
        # Addresses can be made up: only so many are named, though all are counted.
        if host not in self._refused_hosts and len(self._refused_hosts) < _MOST_REFUSED_NAMED:
            self._refused_hosts.add(host)
            self._log.warning(
                "%s: %s sends here and is not among the peers: %s", self._link, host, self._what
            )
        return False


def listen_error(kind: str, link: str, host: str, port: int, error: OSError) -> LinkError:
    """Return the error, with its remedy, of an address that could not be listened on. kind: TCP or UDP."""
    if isinstance(error, socket.gaierror):
        return LinkError(f"unknown host '{host}': give an address of this computer, or 0.0.0.0 for all")
    if error.errno == errno.EADDRINUSE:
        return LinkBusyError(f"{kind} port {port} is in use: stop the other program or choose another port")
    if error.errno == errno.EADDRNOTAVAIL:
        return LinkError(f"{host} is not an address of this computer: use one that is, or 0.0.0.0 for all")
    if error.errno == errno.EACCES:
        return LinkError(f"{kind} port {port} is reserved for the system: choose one above 1023")
    return LinkError(f"{link} cannot be opened: {error.strerror or error}")


@functools.lru_cache(maxsize=512)
def name_of(sender: Address) -> str:
    """Return ``HOST:PORT``; IPv6 in brackets and with its scope, if it has one."""
    host, port, *rest = sender
    if not rest:
        return f"{host}:{port}"
    return f"[{host}%{rest[1]}]:{port}" if rest[1] else f"[{host}]:{port}"


@functools.lru_cache(maxsize=512)
def _is_in(host: str, networks: tuple[Network, ...]) -> bool:
    address = ipaddress.ip_address(host.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    return any(address in network for network in networks)
