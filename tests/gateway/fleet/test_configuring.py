"""Settings pushed to a gateway that runs: shown, confirmed, refused, taken back."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from gateway.errors import GatewayError
from gateway.fleet.configuring import differences, push, settings_of
from gateway.modules.remote import remote_suit
from gateway.outputs.settings import MqttSettings
from gateway.settings import load_gateway_settings, pushed_file
from tests.patience import PATIENCE_S

if TYPE_CHECKING:
    from tests.fixtures.brokers import Mosquitto

pytestmark = pytest.mark.system
Until = Callable[..., Awaitable[None]]
WANTED = {"recording.rotate_minutes": 30, "assembly.rate_hz": 50}


class Running:
    """A gateway in a process of its own, with a file that allows two sections."""

    def __init__(self, folder: Path, broker: Mosquitto, command: Callable[..., Any]) -> None:
        self.file = folder / "gateway.yaml"
        self.settings = MqttSettings(port=broker.port)
        self.file.write_text(
            yaml.safe_dump(
                {
                    "gateway": "ward",
                    "links": [{"name": "suit", "url": str(folder / "absent")}],
                    "rig": "single",
                    "reconstructor": "independent",
                    "mqtt": {"port": broker.port},
                    "recording": {"folder": str(folder / "recordings"), "at_start": True, "min_free_mb": 0},
                    "allow_configuration": ["recording", "assembly"],
                }
            )
        )
        self._own = self.file.read_bytes()
        self._command = command
        self.start()

    def start(self) -> None:
        self.process = self._command("run", "-c", str(self.file))
        self.process.until_said("connected to the MQTT broker")

    async def ask(self, verb: str, data: dict[str, Any]) -> dict[str, Any]:
        async with remote_suit(self.settings, "ward", "gateway") as remote:
            return dict(await remote.perform(verb, data))

    async def instance(self) -> str:
        return str((await self.ask("info", {}))["instance"])

    async def until_another_runs(self, before: str) -> None:
        """A request that comes between two runs is not answered."""
        for _ in range(round(PATIENCE_S)):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1):
                    if await self.instance() != before:
                        return
            await asyncio.sleep(0.5)
        pytest.fail("no other run answers")

    @property
    def in_use(self) -> tuple[float, float]:
        settings = load_gateway_settings(self.file)
        assert self.file.read_bytes() == self._own
        return settings.recording.rotate_minutes, settings.assembly.rate_hz


@pytest.fixture
def gateway(tmp_path: Path, mosquitto: Mosquitto, command: Callable[..., Any]) -> Running:
    return Running(tmp_path, mosquitto, command)


def test_the_command_shows_then_applies_and_says_what_it_did(
    gateway: Running, command: Callable[..., Any]
) -> None:
    typed = ["fleet", "configure", "ward", "--port", gateway.settings.port]
    typed += ["--set", "recording.rotate_minutes=30", "--set", "assembly.rate_hz=50"]
    shown = command(*typed)
    assert shown.wait() == 0
    lines = shown.output.splitlines()
    assert lines[0] == "ward: recording.rotate_minutes: 60.0 → 30.0"
    assert lines[-1] == "nothing was changed: --apply does it"
    assert gateway.in_use == (60, 100)
    applied = command(*typed, "--apply")
    assert applied.wait() == 0
    assert applied.output.splitlines()[-1] == "ward: taken into use and confirmed"
    assert gateway.in_use == (30, 50)
    again = command(*typed, "--apply")
    assert again.wait() == 0
    assert again.output.splitlines() == ["ward: as it was"]


async def test_a_gateway_that_nobody_confirms_goes_back(gateway: Running, until: Until) -> None:
    first = await gateway.instance()
    told = await gateway.ask("configure", {"settings": WANTED, "dry_run": False, "confirm_within_s": 10})
    assert told["applied"]
    assert gateway.in_use == (30, 50)
    await gateway.until_another_runs(first)
    with pytest.raises(GatewayError, match="another change waits"):
        await push(gateway.settings, "ward", {"assembly.rate_hz": 25}, 5)
    gateway.process.until_said("nobody confirmed them within 10 s")
    await until(lambda: not pushed_file(gateway.file).exists())
    assert gateway.in_use == (60, 100)
    gateway.process.until(
        lambda: gateway.process.errors.count("configuration read anew") == 2, "both changes"
    )
    await gateway.until_another_runs(first)
    with pytest.raises(GatewayError, match="no change waits"):
        await gateway.ask("confirm", {"token": told["token"]})


async def test_a_gateway_that_dies_before_it_is_confirmed_starts_with_what_it_had(gateway: Running) -> None:
    assert await push(gateway.settings, "ward", {"assembly.rate_hz": 25}, 20)
    await gateway.ask("configure", {"settings": WANTED, "dry_run": False})
    gateway.process.kill()
    gateway.process.wait()
    assert gateway.in_use == (30, 50)
    gateway.start()
    assert gateway.in_use == (60, 25)
    assert await gateway.instance()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"mqtt.host": "elsewhere"}, "only recording, assembly"),
        ({"allow_configuration": ["mqtt"]}, "not for others to change"),
        ({"recording.folder": "/tmp"}, "never recording.folder"),
        ({"recording": {"folder": "/tmp"}}, "not for others to change"),
        ({"assembly": {"rate_hz": 5}}, "name single settings"),
        ({"assembly.rate_hz": -1}, "at least 0.1"),
        ({"assembly.rat_hz": 50}, "unknown setting 'assembly.rat_hz'"),
        ({"recording.min_free_mb": 1e12}, "MB free, less than"),
    ],
)
async def test_what_is_refused_changes_nothing(
    gateway: Running, settings: dict[str, Any], words: str
) -> None:
    first = await gateway.instance()
    with pytest.raises(GatewayError, match=words):
        await push(gateway.settings, "ward", settings, 10)
    assert not pushed_file(gateway.file).exists()
    assert gateway.in_use == (60, 100)
    assert await gateway.instance() == first


async def test_a_gateway_that_allows_nothing_says_so(
    tmp_path: Path, mosquitto: Mosquitto, command: Callable[..., Any]
) -> None:
    gateway = Running(tmp_path, mosquitto, command)
    gateway.process.kill()
    gateway.process.wait()
    plain = yaml.safe_load(gateway.file.read_text())
    del plain["allow_configuration"]
    gateway.file.write_text(yaml.safe_dump(plain))
    gateway.start()
    with pytest.raises(GatewayError, match=r"allow_configuration in this gateway's file: none"):
        await differences(gateway.settings, "ward", WANTED)


@pytest.mark.parametrize("given", ["recording.rotate_minutes", "=5", "a=[", ""])
def test_what_is_no_setting_is_told(given: str) -> None:
    with pytest.raises(GatewayError, match="NAME=VALUE"):
        settings_of([given])


def test_values_are_read_as_in_a_file() -> None:
    assert settings_of(["a.b=30", "c=true", "d=null", "e=x"]) == {"a.b": 30, "c": True, "d": None, "e": "x"}
    assert json.dumps(settings_of(["f="])) == '{"f": null}'
