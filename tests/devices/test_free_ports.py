"""Ports for servers that are about to start."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from devices import free_ports as ports
from devices.free_ports import free_port, free_ports


def test_no_port_is_given_twice():
    assert len(set(free_ports(200))) == 200


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_a_port_that_somebody_has_is_not_given(kind, monkeypatch):
    first, second = free_ports(2)
    monkeypatch.setattr(ports, "_PORTS", (first, second))
    with socket.socket(type=kind) as taken:
        taken.bind(("127.0.0.1", first))
        assert {free_port() for _ in range(20)} == {second}


def test_no_connection_gets_one_meanwhile():
    """What the system gives to those who connect, or listen at any port, lies above."""
    given = Path("/proc/sys/net/ipv4/ip_local_port_range")
    if not given.exists():
        pytest.skip("not Linux: the system does not tell which ports it gives to connections")
    assert max(ports._PORTS) < int(given.read_text().split()[0])
