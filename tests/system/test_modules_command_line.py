"""``mocap-gateway modules`` as it is typed, on an emulated suit behind a pseudo-terminal."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import signal

import pytest
import yaml
from typer.testing import CliRunner

from devices.emulators.device.emulated_flash import Moment, PowerCut
from devices.emulators.transports import PtyTransport
from firmware_protocol import RELAY
from firmware_protocol.commands import Verb
from gateway.body.rig import load_rig
from gateway.cli.main import app
from gateway.outputs.settings import MqttSettings
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings
from tests.patience import PATIENCE_S
from tests.running_suit import running

pytestmark = pytest.mark.system

RIG = "robot_arm_4"
STILL = "gateway.modules.motion.LEAST_SWING", 1e3
"""The arm moves on its own, now and then as if it were shaken: what says itself that it was tapped counts."""
SHORT_LOOK = "devices.commands.transactions.BROADCAST_WAITS_S", (0.15, 0.25, 0.4)
"""Four modules without a relay answer within 10 ms, unless the machine is busy."""


@pytest.fixture(autouse=True)
def _state_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def suit_on_port(commanded_suit, command, tmp_path):
    """``async with suit_on_port(stored_ids=…) as (suit, modules)``; ``modules("list")`` is typed."""

    @contextlib.asynccontextmanager
    async def start(**settings):
        port = tmp_path / "port"
        async with commanded_suit(RIG, PtyTransport(port), **settings) as suit:
            constants = dict([STILL] if settings.get("has_relay") else [STILL, SHORT_LOOK])
            yield suit, Typed(command, "--link", str(port), "--rig", RIG, constants=constants)

    return start


class Typed:
    """Types commands, each in a process of its own: the suit's event loop goes on meanwhile."""

    def __init__(self, command, *where, constants=None):
        self._command = command
        self._where = where
        self._constants = constants

    def start(self, *arguments):
        return self._command("modules", *arguments, *self._where, constants=self._constants)

    async def __call__(self, *arguments):
        process = self.start(*arguments)
        return await process.ended(), process.output, process.errors


async def test_list_shows_every_module_and_names_a_conflict_with_its_remedy(suit_on_port):
    async with suit_on_port(has_relay=True) as (suit, modules):
        code, output, errors = await modules("list", "--wide", "--listen", "0.5")
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
        code, output, _ = await modules("list", "--listen", "0.5")
        assert code == 1
        assert f"module id 1 is shared by {suit.unique_id(1).hex()} and" in output
        assert "remedy: mocap-gateway modules assign" in output
        assert "not heard: link_3 (2)" in output
        code, output, _ = await modules("list", "--listen", "0.5", "--json")
        assert json.loads(output)["conflicts"][0]["module"] == 1


async def test_a_busy_port_says_how_to_ask_the_gateway_that_holds_it(suit_on_port, until):
    async with suit_on_port() as (suit, modules):
        holder = modules.start("watch")
        await until(lambda: suit.suit.counts.received_bytes > 0)  # it has the port, and asks
        code, output, errors = await modules("list")
        holder.send_signal(signal.SIGINT)
        await holder.ended()
    assert (code, output) == (1, "")
    assert "is busy" in errors
    assert "--mqtt HOST:PORT" in errors
    assert len(errors.splitlines()) == 1
    assert "Traceback" not in holder.errors


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
async def test_a_suit_that_is_not_said_or_not_there_is_one_line(command, where, message):
    code, output, errors = await Typed(command, *where)("list")
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


async def test_backup_and_restore(suit_on_port, command, tmp_path):
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


async def test_an_older_backup_is_replaced_only_when_told_so(suit_on_port, tmp_path):
    """It may be the only one from before a change that is to be taken back."""
    file = tmp_path / "suit.yaml"
    async with suit_on_port() as (_, modules):
        assert (await modules("backup", str(file)))[0] == 0
        kept = file.read_text()
        assert (await modules("set", "1", "label=x", "--allow-writes"))[0] == 0
        code, _, errors = await modules("backup", str(file))
        assert code == 1
        assert "exists: name another file, or replace it with --force" in errors
        assert file.read_text() == kept
        assert (await modules("backup", str(file), "--force"))[0] == 0
        assert file.read_text() != kept


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("links: []", "it has no settings by unique id"),
        ("modules: [{id: 0, segment: pelvis}]", "it has no settings by unique id"),
        (
            "modules: {3: {label: x}}",
            "under 'modules:' '3' is no unique id: 24 hexadecimal digits",
        ),
        (f"modules: {{'{'0' * 24}': [label]}}", f"under '{'0' * 24}:' it has no settings by name"),
    ],
)
async def test_what_is_no_backup_is_said_in_plain_words(tmp_path, command, content, message):
    file = tmp_path / "other.yaml"
    file.write_text(content)
    code, output, errors = await Typed(command, "--link", "/dev/null", "--rig", RIG)("restore", str(file))
    assert (code, output) == (1, "")
    assert f"{file} is no file that `modules backup` wrote: " in errors
    assert message in errors
    assert len(errors.splitlines()) == 1


class Fitter:
    """A person who assigns: shakes what is asked for and answers questions."""

    def __init__(self, suit, process, wearers, keys=()):
        self._suit, self._process, self._wearers, self._keys = suit, process, wearers, list(keys)
        self.lines = []

    async def work(self):
        """Do what every line asks for until the command ends; return its exit code."""
        while True:
            has_ended = self._process.returncode is not None  # before the look: no line comes after it
            whole, _, _ = self._process.output.rpartition("\n")
            for line in whole.splitlines()[len(self.lines) :]:
                self.lines.append(line.strip())
                self._answer(line)
            if has_ended:
                return self._process.returncode
            await asyncio.sleep(0.01)

    def _answer(self, line):
        if "module on the " in line:
            segment = line.strip().partition("module on the ")[2].replace(" ", "_")
            if self._keys and self._keys[0][0] == segment:
                self._process.type(self._keys.pop(0)[1])
            else:
                self._suit.traffic.tap(self._wearers[segment], self._suit.soon_s(0.1))
        elif "do it?" in line:
            self._process.type("y")


async def test_assign_sets_swapped_and_doubled_modules_right(suit_on_port):
    wearers = {"link_1": 0, "link_2": 1, "link_3": 2, "link_4": 3}
    async with suit_on_port(stored_ids={0: 1, 1: 0, 3: 2}) as (suit, modules):
        process = modules.start("assign", "--allow-writes")
        fitter = Fitter(suit, process, wearers)
        code = await asyncio.wait_for(fitter.work(), PATIENCE_S)
        assert code == 0, process.report()
        assert suit.ids() == {n: n for n in range(4)}
    text = "\n".join(fitter.lines)
    assert "conflict: module id 2 is shared by" in text
    assert "[1/4] shake or tap the module on the link 1" in text
    assert "was tapped: it becomes module 0, and module 0" in text


async def test_assign_is_tried_against_an_emulator_that_is_told_what_to_shake(tmp_path, command):
    port = tmp_path / "port"
    emulator = command("emulate", "--rig", RIG, "--link", port, "--json")
    await emulator.until_it_says('"url"')
    assigning = Typed(command, "--link", str(port), "--rig", RIG, constants=dict([STILL])).start(
        "assign", "--segment", "link_4", "--allow-writes", "--yes"
    )
    await assigning.until_it_says("shake or tap the module on the link 4")
    for line in ("wink link 3", "shake link 7", "shake link 3"):
        emulator.type(line)
    assert await assigning.ended() == 0
    assert "was shaken: it becomes module 3, and module 3" in assigning.output
    assert "'wink' is unknown; type shake NAME" in emulator.errors
    assert "no module is on 'link 7' (did you mean 'link_" in emulator.errors
    assert len(emulator.output.splitlines()) == 1


async def test_a_module_that_is_shaken_for_too_long_is_not_taken_for_the_next_segment(suit_on_port):
    class LongShaker(Fitter):
        def _answer(self, line):
            if "module on the link 2" in line and line not in self.lines[:-1]:
                self._suit.traffic.tap(0, self._suit.soon_s(0.1))  # that of link 1 again
            else:
                super()._answer(line)

    wearers = {"link_1": 0, "link_2": 1, "link_3": 2, "link_4": 3}
    async with suit_on_port() as (suit, modules):
        process = modules.start("assign", "--allow-writes", "--yes")
        fitter = LongShaker(suit, process, wearers)
        code = await asyncio.wait_for(fitter.work(), PATIENCE_S)
        assert code == 0, process.report()
        assert suit.ids() == {n: n for n in range(4)}
    assert "which is the one on the link 1: hold it still" in "\n".join(fitter.lines)


async def test_assign_with_skip_undo_and_redo(suit_on_port):
    wearers = {"link_1": 0, "link_2": 1, "link_3": 2, "link_4": 3}
    async with suit_on_port(stored_ids={0: 1, 1: 0}) as (suit, modules):
        process = modules.start("assign", "--allow-writes", "--yes")
        keys = [("link_2", "u"), ("link_3", "s"), ("link_4", "q")]
        fitter = Fitter(suit, process, wearers, keys)
        code = await asyncio.wait_for(fitter.work(), PATIENCE_S)
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
        code, _, errors = await modules(*one)
        assert code == 1
        assert "allow_device_writes: true" in errors
        code, output, errors = await modules(*one, "--yes", "--allow-writes")
        assert (code, errors) == (0, "")
        assert f"link_1: {suit.unique_id(0).hex()} is module 0 now" in output
        assert suit.ids() == {n: n for n in range(4)}


async def test_a_segment_that_gives_no_sign_is_skipped_in_time(suit_on_port):
    async with suit_on_port() as (_, modules):
        timed = ("--allow-writes", "--yes", "--timeout", "1", "--segment", "link_1")
        code, output, _ = await modules("assign", *timed)
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
        process = modules.start("card", "download", "1", str(target))
        await process.until_so(lambda: partial.exists() and partial.stat().st_size >= 5000, "half the file")
        process.kill()
        await process.ended()
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
    await asyncio.wait_for(service.run(), PATIENCE_S)
    assert set(service.pipeline.stream.modules) == {0, 1, 2, 3}
    assert all(record.lost == 0 for record in service.pipeline.stream.modules.values())
    assert service.pipeline.skeleton_frames > 150


async def test_a_running_gateway_is_asked_in_the_same_words(commanded_suit, command, mosquitto, monkeypatch):
    monkeypatch.setattr(*STILL)
    settings = GatewaySettings(
        gateway="lab",
        links=[LinkSettings(name="suit", url="/dev/null")],
        rig=RIG,
        reconstructor="independent",
        mqtt=MqttSettings(port=mosquitto.port),
        allow_device_writes=True,
    )
    # Suit and gateway share this event loop: at so few samples it has time for both on a busy machine, too.
    async with commanded_suit(RIG, sampling_rate_hz=25.0) as suit:
        service = Service(settings, load_rig(RIG), links=[suit.link])
        async with running(service):
            async with asyncio.timeout(PATIENCE_S):
                while not service.requests.is_connected:
                    await asyncio.sleep(0.01)
            modules = Typed(command, "--mqtt", f"127.0.0.1:{mosquitto.port}")
            code, output, errors = await modules("list", "--listen", "0.5")
            assert (code, errors) == (0, "")
            assert suit.unique_id(3).hex() in output
            process = modules.start("assign", "--segment", "link_2", "--yes")
            fitter = Fitter(suit, process, {"link_2": 2})
            assert await asyncio.wait_for(fitter.work(), PATIENCE_S) == 0
            assert suit.ids() == {0: 0, 1: 2, 2: 1, 3: 3}
            code, _, errors = await modules("set", "7", "label=x")
            assert code == 1
            assert "gateway 'lab': no device '7' answers" in errors


@pytest.mark.parametrize(
    "command",
    ["list", "watch", "identify", "assign", "show", "set", "undo", "backup", "restore"]
    + [f"card {each}" for each in ("list", "start", "stop", "download", "erase")],
)
def test_help_has_an_example(command):
    shown = CliRunner().invoke(app, ["modules", *command.split(), "--help"])
    assert shown.exit_code == 0
    assert re.search(rf"Examples?: mocap-gateway modules {command}", " ".join(shown.output.split()))
