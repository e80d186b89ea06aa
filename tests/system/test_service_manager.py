"""``run`` under a service manager: readiness, watchdog, reload, stop; and what its log lines look like."""

from __future__ import annotations

import json
import os
import signal
import socket
import time

import pytest

from gateway.service.systemd import notify, watchdog_interval_s
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system

CONFIG = """
gateway: lab
links: [{{name: suit, url: {folder}/absent}}]
rig: single
reconstructor: independent
mqtt: {{port: {port}, base_topic: {base}}}
"""


class Manager:
    """The other end of NOTIFY_SOCKET."""

    def __init__(self, folder):
        self.path = str(folder / "notify")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.path)
        self.told = []

    def await_telling(self, wanted):
        deadline = time.monotonic() + PATIENCE_S
        while not any(wanted in line for line in self.told):
            self._socket.settimeout(max(0.01, deadline - time.monotonic()))
            self.told += self._socket.recv(4096).decode().splitlines()

    def close(self):
        self._socket.close()


@pytest.fixture
def manager(tmp_path):
    manager = Manager(tmp_path)
    yield manager
    manager.close()


def logged(process):
    """All its log lines so far."""
    whole, _, _ = process.errors.rpartition("\n")
    return [json.loads(line) for line in whole.splitlines()]


def await_message(process, wanted):
    process.until(lambda: any(wanted in line["message"] for line in logged(process)), f"'{wanted}'")


def test_ready_watched_reloaded_and_stopped(mosquitto, command, manager, tmp_path):
    config = tmp_path / "gateway.yaml"
    config.write_text(CONFIG.format(folder=tmp_path, port=mosquitto.port, base="mocap"))
    environment = {"NOTIFY_SOCKET": manager.path, "WATCHDOG_USEC": "600000"}
    process = command("run", "-c", config, environment=environment)
    manager.await_telling("READY=1")
    manager.await_telling("WATCHDOG=1")

    config.write_text("links: []\n")
    process.send_signal(signal.SIGHUP)
    await_message(process, "the changed configuration is not taken")
    assert process.returncode is None

    config.write_text(CONFIG.format(folder=tmp_path, port=mosquitto.port, base="elsewhere"))
    process.send_signal(signal.SIGHUP)
    await_message(process, "publishing on elsewhere/lab")

    process.terminate()
    await_message(process, "stopped")
    assert process.wait() == 0
    manager.await_telling("STOPPING=1")
    assert {"time", "level", "logger", "message"} <= set(logged(process)[0])


def test_without_a_manager_nothing_is_told(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere/at/all")
    assert not notify("READY=1")


@pytest.mark.parametrize(
    ("microseconds", "pid", "interval_s"),
    [
        ("", "", None),
        ("abc", "", None),
        ("3000000", "", 1.0),
        ("3000000", "own", 1.0),
        ("3000000", "1", None),
    ],
)
def test_who_is_watched(monkeypatch, microseconds, pid, interval_s):
    monkeypatch.setenv("WATCHDOG_USEC", microseconds)
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()) if pid == "own" else pid)
    assert watchdog_interval_s() == interval_s
