"""Whether a method has to be compiled first."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from gateway.body.rig import load_rig
from gateway.errors import GatewayError
from gateway.geometry import compiled
from gateway.reconstruction import FUSED, RECONSTRUCTORS
from gateway.service import readiness
from gateway.settings import fitting_suit, load_gateway_settings
from tests.fixtures.processes import REPOSITORY
from tests.marked_person import subject_file


@pytest.fixture
def empty(monkeypatch, tmp_path):
    """An empty cache, and nothing shipped."""
    monkeypatch.setattr(compiled, "CACHE_DIRECTORY", tmp_path / "cache")
    monkeypatch.setattr(compiled, "SHIPPED", tmp_path / "shipped")
    return tmp_path / "cache"


@pytest.fixture
def let_through(empty):
    """``FIRST``, noted after bytes went through the pipeline in a process of its own; the cache."""
    there = os.environ | {"NUMBA_CACHE_DIR": str(empty)}
    subprocess.run([*readiness.command("x")[:-1], f"through:{readiness.FIRST}"], env=there, check=True)
    return empty


def test_what_takes_orientations_from_the_modules_is_ready_always(empty):
    for name in FUSED:
        assert readiness.is_ready(name)


def test_a_subject_with_markers_waits_for_no_method_of_modules(empty, tmp_path):
    """`run` fell back to one, which such a subject cannot have, and refused to start."""
    path, _, _ = subject_file(tmp_path, "z")
    config = tmp_path / "lab.yaml"
    config.write_text(f"links: [{{name: cameras, url: 'udp://:0', carries: markers}}]\nrig: {path.name}\n")
    settings = load_gateway_settings(config)
    assert readiness.is_ready(fitting_suit(settings, load_rig(settings.rig, config)).reconstructor)


def test_in_an_empty_cache_no_method_is_ready_that_must_be_compiled(empty):
    assert not any(readiness.is_ready(name) for name in set(RECONSTRUCTORS) - FUSED)
    assert readiness.in_words(readiness.readiness("joint")) == "not compiled yet, or changed since"


@pytest.mark.slow(reason="compiles for ten seconds or more into an empty cache")
def test_a_method_is_ready_while_all_that_it_called_is_there_as_it_was(let_through, monkeypatch):
    found = readiness.readiness(readiness.FIRST)
    assert found.is_complete
    assert found.kernels > 10
    assert readiness.is_ready(readiness.FIRST)
    assert not readiness.is_ready("joint")

    index = next(compiled.kept().glob("gateway.body.*/*.nbi"))
    index.rename(index.with_suffix(".away"))
    assert readiness.readiness(readiness.FIRST) == (found.kernels - 1, found.kernels)
    assert not readiness.is_ready(readiness.FIRST)
    index.with_suffix(".away").rename(index)

    monkeypatch.setattr(compiled.KernelState, "is_current", False)
    assert not readiness.is_ready(readiness.FIRST)
    monkeypatch.undo()


@pytest.mark.slow(reason="compiles for ten seconds or more into an empty cache")
def test_kernels_that_were_shipped_are_taken(let_through, tmp_path):
    """Moved as a wheel or an image moves them, with other times, and beside a cache that is empty."""
    shutil.copytree(let_through, tmp_path / "shipped", copy_function=shutil.copyfile)
    shutil.rmtree(let_through)
    assert readiness.readiness(readiness.FIRST).is_complete
    done = subprocess.run(
        [sys.executable, "-c", SHIPPED, str(tmp_path / "shipped")],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "own")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"compiled": 0, "poses": True}
    assert list((tmp_path / "own").glob("*/gateway.*/*.nbi"))


SHIPPED = """
import json, sys
from pathlib import Path
from numba.core import event
from gateway.geometry import compiled
from gateway.service import compiling, readiness
compiled.SHIPPED = Path(sys.argv[1])
with event.install_recorder("numba:compile") as recorded:
    compiling._let_through(readiness.FIRST)
print(json.dumps({"compiled": len(recorded.buffer), "poses": readiness.is_ready(readiness.FIRST)}))
"""


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
    assert not list(tmp_path.glob("*/*root_position*"))
    assert list(tmp_path.glob("*/ready-first-*"))


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


def test_a_running_suit_compiles_nothing_once_its_method_is_ready():
    """What compiles while samples come holds them all up for seconds."""
    readiness.make_ready("joint")
    done = subprocess.run(
        [sys.executable, "-c", RUNS], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"compiled": [], "poses": True}


RUNS = """
import json
from numba.core import event
from devices.emulators.imperfections import TYPICAL
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.pipeline import Pipeline
from gateway.service.compiling import _PARAMS
compiled, poses = [], 0
class Watch(event.Listener):
    def on_start(self, event):
        compiled.append(str(event.data["dispatcher"]))
    def on_end(self, event):
        pass
suit = load_rig("arm_3")
traffic = SuitTraffic(move(dress(suit), suit.skeleton.name, 1), SuitSettings(), TYPICAL, 1)
with event.install_listener("numba:compile", Watch()):
    pipeline = Pipeline(suit, _PARAMS, "joint")
    pipeline.add_link("suit", Framing.BYTE_STREAM)
    told_s = 0.0
    for sent in traffic.transmissions(15.0):
        poses += len(pipeline.feed(Chunk(sent.data, 10**18 + round(sent.time_s * 1e9), "suit")))
        if sent.time_s > told_s + 1.0:
            told_s = sent.time_s
            pipeline.statistics()
print(json.dumps({"compiled": compiled, "poses": poses > 1000}))
"""


def test_a_module_worn_wrong_calls_no_kernel_that_was_not_compiled_beforehand():
    """The first explanation of how it is worn stopped a running suit for five seconds."""
    done = subprocess.run(
        [sys.executable, "-c", WORN_WRONG], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"later": [], "doubts": [12]}


WORN_WRONG = """
import json
from devices.emulators.imperfections import TYPICAL
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move, worn_wrong
from gateway.geometry import compiled
from gateway.pipeline import Pipeline
from gateway.service import compiling
compiling._let_through("joint")
beforehand = set(compiled.called())
suit = load_rig("suit_lower_7")
motion = move(worn_wrong(dress(suit), [12], []), suit.skeleton.name, 1)
pipeline = Pipeline(suit, compiling._PARAMS, "joint")
pipeline.add_link("suit", Framing.BYTE_STREAM)
for sent in SuitTraffic(motion, SuitSettings(), TYPICAL, 1).transmissions(14.0):
    pipeline.feed(Chunk(sent.data, 10**18 + round(sent.time_s * 1e9), "suit"))
new = set(compiled.called()) - beforehand
later = [kernel.name for kernel in new if kernel.module.startswith("gateway.reconstruction.")]
print(json.dumps({"later": later, "doubts": list(pipeline.module_stage.doubts())}))
"""


def test_a_part_that_fails_is_told(empty, monkeypatch):
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    with pytest.raises(GatewayError, match="compiling failed in the part"):
        readiness.make_ready("joint")


def test_an_unknown_method_is_refused_by_the_command():
    done = subprocess.run(readiness.command("magic"), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "no method is called 'magic'" in done.stderr


@pytest.mark.parametrize("after_s", [2.0, 4.0])
def test_ctrl_c_ends_what_compiles_without_a_trace_of_the_program(after_s, tmp_path):
    """It reaches all processes of the terminal: whoever ended a first start was shown four traces."""
    process = subprocess.Popen(
        readiness.command("joint"),
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    time.sleep(after_s)
    os.killpg(process.pid, signal.SIGINT)
    _, told = process.communicate(timeout=30)
    assert process.returncode != 0
    assert "gateway/" not in told  # Python's own beginning, before anything of ours is read, may be hit


def test_a_process_that_compiles_says_nothing_when_the_one_that_asked_has_ended():
    reader, writer = os.pipe()
    os.close(reader)
    command = [*readiness.command("x")[:-1], "parts"]
    ended = subprocess.run(
        command, input="fused\n", stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (0, "")
