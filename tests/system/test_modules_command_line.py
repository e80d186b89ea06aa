"""``mocap-gateway modules`` as it is typed, on an emulated suit behind a pseudo-terminal."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import subprocess
import sys
from typing import ClassVar

import pytest
import yaml
from typer.testing import CliRunner

from devices.emulators.power_cut import Moment, PowerCut
from devices.emulators.transports import PtyTransport
from firmware_protocol import RELAY
from firmware_protocol.commands import Verb
from gateway.body.rig import load_rig
from gateway.cli.main import app
from gateway.outputs.settings import MqttSettings
from gateway.service import Service
from gateway.settings import GatewaySettings, LinkSettings
from tests.patience import PATIENCE_S
from tests.typed_here import typed_here

pytestmark = pytest.mark.system

RIG = "robot_arm_4"
LONGEST_S = 100
"""Of a command, on a machine that does much else."""


@pytest.fixture(autouse=True)
async def _state_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    yield
    while Typed.started:  # of a test that failed
        process = Typed.started.pop()
        if process.returncode is None:
            process.kill()
            await process.wait()


@pytest.fixture
def suit_on_port(commanded_suit, tmp_path):
    """``async with suit_on_port(stored_ids=…) as (suit, modules)``; ``modules("list")`` is typed."""

    @contextlib.asynccontextmanager
    async def start(**settings):
        port = tmp_path / "port"
        async with commanded_suit(RIG, PtyTransport(port), **settings) as suit:
            yield suit, Typed("--link", str(port), "--rig", RIG)

    return start


class Typed:
    """Types commands and sees what a user sees: in a process of its own where it reads what is typed or
    is killed (``start``), else in a thread, as starting Python takes longer than most commands."""

    started: ClassVar[list[asyncio.subprocess.Process]] = []

    def __init__(self, *where):
        self._where = where

    async def start(self, *arguments):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "gateway", "modules", *arguments, *self._where),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self.started.append(process)
        return process

    async def __call__(self, *arguments):
        typed = ["modules", *arguments, *self._where]
        return await asyncio.wait_for(asyncio.to_thread(typed_here, typed), LONGEST_S)

    async def in_a_process(self, *arguments):
        process = await self.start(*arguments)
        output, errors = await asyncio.wait_for(process.communicate(), LONGEST_S)
        return process.returncode, output.decode(), errors.decode()


async def test_list_shows_every_module_and_names_a_conflict_with_its_remedy(suit_on_port):
    async with suit_on_port(has_relay=True) as (suit, modules):
        code, output, errors = await modules.in_a_process("list", "--listen", "1")
        assert (code, errors) == (0, "")
        for number, segment in enumerate(("link_1", "link_2", "link_3", "link_4")):
            (line,) = [line for line in output.splitlines() if suit.unique_id(number).hex() in line]
            assert f" {number} " in line
            assert segment in line
            assert "1.0.0" in line
            assert " % " in line
        assert "relay" in output
        assert "conflict" not in output
    async with suit_on_port(stored_ids={2: 1}) as (suit, modules):
        code, output, _ = await modules("list", "--listen", "1")
        assert code == 1
        assert f"module id 1 is shared by {suit.unique_id(1).hex()} and" in output
        assert "remedy: mocap-gateway modules assign" in output
        assert "not heard: link_3 (2)" in output
        code, output, _ = await modules("list", "--listen", "1", "--json")
        assert json.loads(output)["conflicts"][0]["module"] == 1


async def test_a_busy_port_says_how_to_ask_the_gateway_that_holds_it(suit_on_port, until):
    async with suit_on_port() as (suit, modules):
        holder = await modules.start("watch")
        await until(lambda: suit.suit.counts.received_bytes > 0, LONGEST_S)  # it has the port, and asks
        code, output, errors = await modules.in_a_process("list")
        holder.send_signal(signal.SIGINT)
        _, complaints = await asyncio.wait_for(holder.communicate(), PATIENCE_S)
    assert (code, output) == (1, "")
    assert "is busy" in errors
    assert "--mqtt HOST:PORT" in errors
    assert len(errors.splitlines()) == 1
    assert b"Traceback" not in complaints


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ((), "where is the suit? give -c CONFIG, or --link PORT --rig RIG, or --mqtt HOST:PORT"),
        (("--link", "/dev/null"), "--link needs --rig"),
        (("--mqtt", "localhost"), "write HOST:PORT"),
        (("--link", "/nowhere/port", "--rig", RIG), "/nowhere/port"),
        (("-c", "absent.yaml"), "absent.yaml: no such file"),
    ],
)
async def test_a_suit_that_is_not_said_or_not_there_is_one_line(where, message):
    code, output, errors = await Typed(*where)("list")
    assert (code, output) == (1, "")
    assert message in errors
    assert len(errors.splitlines()) == 1


async def test_identify_set_show_and_undo(suit_on_port):
    async with suit_on_port() as (suit, modules):
        code, output, _ = await modules("identify", "2", "--seconds", "30")
        assert (code, output) == (
            0,
            f"module 2 (unique id {suit.unique_id(2).hex()}) blinks for 30 s\n",
        )
        assert suit.traffic.device(2).is_blinking(suit.soon_s())

        setting = ("set", "2", "label=left", "sampling_rate=50")
        code, output, errors = await modules(*setting)
        assert (code, output) == (1, "")
        assert "allow_device_writes: true" in errors
        assert "--allow-writes" in errors
        assert suit.traffic.device(2).settings["label"] == ""

        code, output, errors = await modules(*setting, "--allow-writes")
        assert (code, errors) == (0, "")
        assert "sampling_rate 100 → 50" in output
        assert suit.traffic.device(2).settings["label"] == "left"

        code, output, _ = await modules("show", "2")
        shown = yaml.safe_load(output)
        assert (shown["label"], shown["sampling_rate"]) == ("left", 50.0)

        code, output, _ = await modules("undo", "--allow-writes")
        assert code == 0
        assert "sampling_rate 50 → 100" in output
        assert suit.traffic.device(2).settings["label"] == ""


async def test_backup_and_restore(suit_on_port, tmp_path):
    file = tmp_path / "suit.yaml"
    async with suit_on_port() as (suit, modules):
        code, output, _ = await modules("backup", str(file))
        assert (code, output) == (0, f"settings of 4 modules are in {file}\n")
        code, _, errors = await modules("set", "1", "label=x", "module_id=9", "--allow-writes")
        assert (code, errors) == (0, "")
        assert suit.ids()[1] == 9
        code, output, errors = await modules("restore", str(file), "--allow-writes")
        assert (code, errors) == (0, "")
        assert "module_id 9 → 1" in output
        assert suit.ids()[1] == 1
        assert suit.traffic.device(1).settings["label"] == ""
    (tmp_path / "other.yaml").write_text("links: []\n")
    code, _, errors = await Typed("--link", "/dev/null", "--rig", RIG)(
        "restore", str(tmp_path / "other.yaml")
    )
    assert code == 1
    assert "no backup of modules" in errors


class Fitter:
    """A person who assigns: shakes what is asked for and answers questions."""

    def __init__(self, suit, process, wearers, keys=()):
        self._suit, self._process, self._wearers, self._keys = suit, process, wearers, list(keys)
        self.lines = []

    async def work(self):
        async for raw in self._process.stdout:
            line = raw.decode().strip()
            self.lines.append(line)
            if "module on the " in line:
                segment = line.partition("module on the ")[2].replace(" ", "_")
                if self._keys and self._keys[0][0] == segment:
                    self._type(self._keys.pop(0)[1])
                else:
                    self._suit.traffic.tap(self._wearers[segment], self._suit.soon_s(0.1))
            elif "do it?" in line:
                self._type("y")
        return await self._process.wait()

    def _type(self, key):
        self._process.stdin.write(f"{key}\n".encode())


async def test_assign_sets_swapped_and_doubled_modules_right(suit_on_port):
    wearers = {"link_1": 0, "link_2": 1, "link_3": 2, "link_4": 3}
    async with suit_on_port(stored_ids={0: 1, 1: 0, 3: 2}) as (suit, modules):
        process = await modules.start("assign", "--allow-writes")
        fitter = Fitter(suit, process, wearers)
        code = await asyncio.wait_for(fitter.work(), LONGEST_S)
        assert code == 0, await process.stderr.read()
        assert suit.ids() == {n: n for n in range(4)}
    text = "\n".join(fitter.lines)
    assert "conflict: module id 2 is shared by" in text
    assert "[1/4] shake or tap the module on the link 1" in text
    assert "was tapped: it becomes module 0, and module 0" in text


async def test_assign_with_skip_undo_and_redo(suit_on_port):
    wearers = {"link_1": 0, "link_2": 1, "link_3": 2, "link_4": 3}
    async with suit_on_port(stored_ids={0: 1, 1: 0}) as (suit, modules):
        process = await modules.start("assign", "--allow-writes", "--yes")
        keys = [("link_2", "u"), ("link_3", "s"), ("link_4", "q")]
        fitter = Fitter(suit, process, wearers, keys)
        code = await asyncio.wait_for(fitter.work(), LONGEST_S)
        assert code == 1  # two were skipped
        assert suit.ids() == {n: n for n in range(4)}
    text = "\n".join(fitter.lines)
    assert text.count("module on the link 1") == 2  # once more after the undo
    assert "not assigned: link_3, link_4" in text
    assert f"{suit.unique_id(0).hex()}: module_id 0 → 1" in text


async def test_assign_by_name_without_shaking_survives_a_module_that_restarts(suit_on_port):
    async with suit_on_port(stored_ids={0: 1, 1: 0}) as (suit, modules):
        suit.traffic.device(0).power_cut = PowerCut(Verb.COMMIT, moment=Moment.IN_FLASH, flash_step=10)
        one = ("assign", "--segment", "link_1", "--device", suit.unique_id(0).hex())
        code, _, errors = await modules.in_a_process(*one)
        assert code == 1
        assert "allow_device_writes: true" in errors
        code, output, errors = await modules.in_a_process(*one, "--yes", "--allow-writes")
        assert (code, errors) == (0, "")
        assert f"link_1: {suit.unique_id(0).hex()} is module 0 now" in output
        assert suit.ids() == {n: n for n in range(4)}


async def test_a_segment_that_gives_no_sign_is_skipped_in_time(suit_on_port):
    async with suit_on_port() as (_, modules):
        timed = ("--allow-writes", "--yes", "--timeout", "1", "--segment", "link_1")
        code, output, _ = await modules.in_a_process("assign", *timed)
    assert code == 1
    assert "nothing moved in time: skipped" in output
    assert "not assigned: link_1" in output


async def test_a_card_download_that_is_killed_goes_on_and_the_file_replays(suit_on_port, tmp_path, until):
    target = tmp_path / "walk.mcap"
    partial = tmp_path / "walk.mcap.card.part"
    async with suit_on_port(has_relay=True) as (suit, modules):
        code, output, _ = await modules("card", "start")
        assert (code, output) == (0, "the card records\n")
        relay = suit.traffic.device(RELAY)
        await until(lambda: relay.card.entries()[0].size > 30_000)
        relay.happen(0.0, relay.stop)
        await until(lambda: relay.card.recording is None)
        (entry,) = relay.card.entries()
        process = await modules.start("card", "download", "1", str(target))
        async with asyncio.timeout(PATIENCE_S):
            while not partial.exists() or partial.stat().st_size < 5000:
                await asyncio.sleep(0.005)
        process.kill()
        await process.wait()
        came = partial.stat().st_size
        assert 0 < came < entry.size
        assert not target.exists()

        heard_before = suit.suit.counts.received_bytes
        code, output, errors = await modules("card", "download", "1", str(target))
        assert (code, errors) == (0, "")
        assert "checksum verified" in output
        assert "recording://" in output
        asked = (suit.suit.counts.received_bytes - heard_before) / 42  # bytes of one request, about
        assert asked < 1.5 * (entry.size - came) / 192 + 60  # only the rest was asked for

        code, output, _ = await modules("card", "erase", "1", "--allow-writes")
        assert (code, output) == (0, "file 1 is erased\n")
    settings = GatewaySettings(
        links=[LinkSettings(name="card", url=f"recording://{target}?speed=max")],
        rig=RIG,
        reconstructor="independent",
        mqtt=MqttSettings(broker="embedded", port=0),
    )
    service = Service(settings, load_rig(RIG))
    await asyncio.wait_for(service.run(), LONGEST_S)
    assert set(service.pipeline.stream.modules) == {0, 1, 2, 3}
    assert all(record.lost == 0 for record in service.pipeline.stream.modules.values())
    assert service.pipeline.skeleton_frames > 150


async def test_a_running_gateway_is_asked_in_the_same_words(commanded_suit, mosquitto):
    settings = GatewaySettings(
        gateway="lab",
        links=[LinkSettings(name="suit", url="/dev/null")],
        rig=RIG,
        reconstructor="independent",
        mqtt=MqttSettings(port=mosquitto.port),
        allow_device_writes=True,
    )
    async with commanded_suit(RIG) as suit:
        service = Service(settings, load_rig(RIG), links=[suit.link])
        serving = asyncio.create_task(service.run())
        async with asyncio.timeout(PATIENCE_S):
            while not service.requests.is_connected:
                await asyncio.sleep(0.01)
        modules = Typed("--mqtt", f"127.0.0.1:{mosquitto.port}")
        code, output, errors = await modules("list", "--listen", "1")
        assert (code, errors) == (0, "")
        assert suit.unique_id(3).hex() in output
        process = await modules.start("assign", "--segment", "link_2", "--yes")
        fitter = Fitter(suit, process, {"link_2": 2})
        assert await asyncio.wait_for(fitter.work(), LONGEST_S) == 0
        assert suit.ids() == {0: 0, 1: 2, 2: 1, 3: 3}
        code, _, errors = await modules("set", "7", "label=x")
        assert code == 1
        assert "gateway 'lab': no device '7' answers" in errors
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


@pytest.mark.parametrize(
    "command",
    ["list", "watch", "identify", "assign", "show", "set", "undo", "backup", "restore"]
    + [f"card {each}" for each in ("list", "start", "stop", "download", "erase")],
)
def test_help_has_an_example(command):
    shown = CliRunner().invoke(app, ["modules", *command.split(), "--help"])
    assert shown.exit_code == 0
    assert f"Example: mocap-gateway modules {command}" in " ".join(shown.output.split())
