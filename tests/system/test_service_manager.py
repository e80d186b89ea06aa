"""``run`` under a service manager: readiness, watchdog, reload, stop; and what its log lines look like."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time

import pytest

from gateway.service_manager import notify, watchdog_interval_s
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

    def await_telling(self, wanted, timeout_s=60):
        deadline = time.monotonic() + timeout_s
        while not any(wanted in line for line in self.told):
            self._socket.settimeout(max(0.01, deadline - time.monotonic()))
            self.told += self._socket.recv(4096).decode().splitlines()

    def close(self):
        self._socket.close()


@contextlib.contextmanager
def running(folder, port):
    """``mocap-gateway run`` as systemd would start it: (process, manager, configuration file)."""
    config = folder / "gateway.yaml"
    config.write_text(CONFIG.format(folder=folder, port=port, base="mocap"))
    manager = Manager(folder)
    environment = os.environ | {"NOTIFY_SOCKET": manager.path, "WATCHDOG_USEC": "600000"}
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "gateway", "run", "-c", str(config)], env=environment, stderr=log
        )
    try:
        yield process, manager, config
    finally:
        process.kill()
        process.wait(PATIENCE_S)
        manager.close()


def log_lines(folder):
    return [json.loads(line) for line in (folder / "log").read_text().splitlines()]


def await_message(folder, wanted, timeout_s=2 * PATIENCE_S):
    deadline = time.monotonic() + timeout_s
    while not any(wanted in line["message"] for line in log_lines(folder)):
        assert time.monotonic() < deadline, log_lines(folder)
        time.sleep(0.05)


@pytest.mark.timeout(400)  # its first start may compile, on a machine that is busy
def test_ready_watched_reloaded_and_stopped(mosquitto, tmp_path):
    with running(tmp_path, mosquitto.port) as (process, manager, config):
        manager.await_telling("READY=1", timeout_s=10 * PATIENCE_S)
        manager.await_telling("WATCHDOG=1")

        config.write_text("links: []\n")
        process.send_signal(signal.SIGHUP)
        await_message(tmp_path, "the changed configuration is not taken")
        assert process.poll() is None

        config.write_text(CONFIG.format(folder=tmp_path, port=mosquitto.port, base="elsewhere"))
        process.send_signal(signal.SIGHUP)
        await_message(tmp_path, "publishing on elsewhere/lab")

        begun = time.monotonic()
        process.send_signal(signal.SIGTERM)
        await_message(tmp_path, "stopped")
        assert time.monotonic() - begun < 5.0
        assert process.wait(60) == 0  # the interpreter's own end takes as long as the machine is busy
        manager.await_telling("STOPPING=1", timeout_s=PATIENCE_S)
    lines = log_lines(tmp_path)
    assert {"time", "level", "logger", "message"} <= set(lines[0])


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
