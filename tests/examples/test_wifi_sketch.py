"""The wireless firmware example, compiled with a stand-in for the ESP32: several on one port, also signed."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import socket
import subprocess
import time
from pathlib import Path

import pytest

from devices.free_ports import free_port
from devices.links.signed_link import read_key, time_count, write_key
from firmware_protocol import (
    Acknowledgement,
    Command,
    Defect,
    FrameDecoder,
    PacketDecoder,
    Verb,
    encode_frame,
    wire_frame,
)
from firmware_protocol.commands import encode_arguments
from firmware_protocol.messages import ANYONE
from firmware_protocol.signing import SignedFrames
from gateway.body.rig import load_rig
from gateway.modules.journal import Journal
from gateway.modules.session import suit_session
from gateway.sources.link_settings import LinkSettings
from tests.patience import PATIENCE_S

REPOSITORY = Path(__file__).parents[2]
SKETCH = REPOSITORY / "examples" / "arduino" / "wifi_module"
STUBS = (Path(__file__).parent / "wifi_stub", Path(__file__).parent / "arduino_stub")
MODULES = (1, 5, 9)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """The sketch as a program, by the key that it was given; none: it signs nothing."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed, so the sketch cannot be compiled")
    folder = tmp_path_factory.mktemp("sketch")

    def compiled(key=None):
        path = folder / ("module" if key is None else "signing_module")
        folders = [f"-I{each}" for each in (*STUBS, SKETCH, REPOSITORY / "firmware_protocol" / "c")]
        flags = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined"]
        flags += [] if key is None else [f'-DMOCAP_KEY="{key}"']
        command = [compiler, *flags, *folders, str(STUBS[0] / "main.cpp"), "-o", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == 0, done.stderr
        return path

    return functools.cache(compiled)


@pytest.fixture(scope="module")
def key_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("keys") / "wifi.key"
    write_key(path)
    return path


@contextlib.contextmanager
def running(program, module, port, flash):
    """The sketch of one module; its light is told on standard output."""
    told = os.environ | {"MODULE": str(module), "PORT": str(port), "FLASH": str(flash)}
    with subprocess.Popen([program], env=told, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("is_signed", [False, True], ids=["plain", "signed"])
async def test_several_are_listed_and_one_of_them_is_found(compiled, key_file, is_signed, tmp_path):
    port = free_port()
    program = compiled(read_key(key_file).hex() if is_signed else None)
    query = f"&key_file={key_file}" if is_signed else ""
    with contextlib.ExitStack() as stack:
        processes = {
            module: stack.enter_context(running(program, module, port, tmp_path / f"flash{module}"))
            for module in MODULES
        }
        links = [LinkSettings(name="wifi", url=f"udp://127.0.0.1:{port}?peers=127.0.0.0/8{query}")]
        journal = Journal(tmp_path / "journal.json")
        async with suit_session(
            links, load_rig("wifi_10"), allow_writes=False, journal=journal
        ) as operations:
            listed = {
                module["module"]: module for module in (await operations.perform("list", {}))["modules"]
            }
            assert sorted(listed) == list(MODULES)
            assert all(module["unique_id"] for module in listed.values())
            assert all(module["rate_hz"] > 10 for module in listed.values())
            await operations.perform("identify", {"device": "5", "seconds": 60})
            health = operations.stream.modules[5].health
            assert health is not None
            assert health.rssi_dbm == -50
        assert processes[5].stdout.readline() == b"shines\n"
        for process in processes.values():
            process.kill()
        assert [processes[module].stdout.read() for module in MODULES] == [b""] * len(MODULES)


class Host:
    """The gateway's end of a signed link, and somebody who sends from its address."""

    def __init__(self, key):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(PATIENCE_S)
        self.port = self.socket.getsockname()[1]
        self.end = SignedFrames(key, count=time_count())
        self.decoder = PacketDecoder(FrameDecoder())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def packets(self):
        """Of one datagram that is rightly signed; it answers those whose sender has lost count."""
        while True:
            datagram, self.module = self.socket.recvfrom(2000)
            found = self.decoder.feed(self.end.open(datagram))
            if found:
                return [packet.packet for packet in found]
            assert self.end.owes_count
            self.send(self.end.sign(b"\0"))

    def send(self, data):
        self.socket.sendto(data, self.module)

    def ask(self, transaction, frame):
        """The transactions that are acknowledged up to this one. Datagrams get lost on a busy machine, and
        those of a module that is gone may still wait here: it is sent again and again, as a gateway does."""
        found, due = set(), 0.0
        while transaction not in found:
            if time.monotonic() >= due:
                self.send(self.end.sign(frame))
                due = time.monotonic() + 0.5
            found |= {each.transaction for each in self.packets() if isinstance(each, Acknowledgement)}
        return found


def command(transaction, verb, *arguments):
    asked = Command(transaction, verb, ANYONE, encode_arguments(verb, *arguments))
    return encode_frame(wire_frame(asked, 1, 0, 0))


def test_a_sketch_with_a_key_obeys_the_gateway_alone_across_restarts(compiled, key_file, tmp_path):
    key = read_key(key_file)
    program, flash = compiled(key.hex()), tmp_path / "flash"
    shine = command(1, Verb.IDENTIFY, 60)
    with Host(key) as host:
        with running(program, 1, host.port, flash) as module:
            host.packets()
            host.send(shine)
            host.send(SignedFrames(bytes(32), count=time_count()).sign(shine))
            assert host.ask(2, command(2, Verb.GET_INFO)) == {2}
            recorded = host.end.sign(shine)
            host.send(recorded)
            host.ask(1, shine)
            assert module.stdout.readline() == b"shines\n"
        with running(program, 1, host.port, flash) as module:
            host.packets()
            host.send(recorded)
            host.ask(3, command(3, Verb.GET_INFO))
            module.kill()
            assert module.stdout.read() == b""
    assert host.end.dropped.keys() == {Defect.OUTDATED}
