"""Whether a method has to be compiled first."""

import json
import os
import subprocess
import sys

import pytest

from gateway.geometry import compiled
from gateway.reconstruction import FUSED, RECONSTRUCTORS
from gateway.service import readiness


@pytest.fixture
def created(monkeypatch, tmp_path):
    """An empty cache, and the names of the methods that were made in it."""
    names = []
    monkeypatch.setattr(compiled, "CACHE_DIRECTORY", tmp_path)
    monkeypatch.setattr(readiness, "create_reconstructor", lambda name, *_, **__: names.append(name))
    return names


def test_a_long_compiled_method_is_ready_once_it_was_made(created):
    assert not readiness.is_ready("joint")
    readiness.make_ready("joint")
    readiness.make_ready("joint")
    assert created == ["joint"]
    assert readiness.is_ready("joint")
    assert not readiness.is_ready("outward")


def test_what_takes_orientations_from_the_modules_is_ready_always(created):
    for name in FUSED:
        assert readiness.is_ready(name)


def test_a_method_by_itself_that_lets_the_body_walk_is_compiled_beforehand_too(created):
    assert not any(readiness.is_ready(name) for name in set(RECONSTRUCTORS) - FUSED)


@pytest.mark.slow(reason="compiles for ten seconds or more into an empty cache")
def test_what_stands_in_finds_all_it_needs_compiled_and_needs_few_kernels(tmp_path):
    there = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", STANDS_IN], env=there, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["told"][0].startswith("first start: compiling what the first poses need")
    assert said["compiled_later"] == []
    assert not list(tmp_path.glob("*root_position*"))
    assert list(tmp_path.glob("ready-first-*"))


STANDS_IN = """
import json
from numba.core import event
from gateway.body.rig import load_rig
from gateway.cli.preparing import stand_in
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings
told, later = [], []
class Watch(event.Listener):
    def on_start(self, event):
        later.append(str(event.data["dispatcher"]))
    def on_end(self, event):
        pass
links = [LinkSettings(name="suit", url="/dev/ttyUSB0")]
settings = stand_in(GatewaySettings(links=links, rig="suit_17"), told.append)
with event.install_listener("numba:compile", Watch()):
    Service(settings, load_rig("suit_17"))
print(json.dumps({"told": told, "compiled_later": later}))
"""


def test_a_cache_that_cannot_be_written_does_no_harm(created, monkeypatch, tmp_path):
    monkeypatch.setattr(compiled, "CACHE_DIRECTORY", tmp_path / "absent")
    readiness.make_ready("joint")
    assert created == ["joint"]
    assert not readiness.is_ready("joint")


def test_an_unknown_method_is_refused_by_the_command():
    done = subprocess.run(readiness.command("magic"), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "no method is called 'magic'" in done.stderr
