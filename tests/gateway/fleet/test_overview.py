"""What is known of every gateway: counted by number, told as alerts, shown in terminal and page."""

from __future__ import annotations

import asyncio
import contextlib
import json
import urllib.request
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

import aiomqtt
import orjson
import psutil
import pytest

from gateway.contract.messages import BridgeHealth, BridgeInfo, OutputCounters, UtcAnchor
from gateway.errors import GatewayError
from gateway.fleet import cluster as clusters
from gateway.fleet.overview import Fleet, OverviewRow, as_plain, listener, take_into
from gateway.fleet.page import Bodies, OverviewServer
from gateway.outputs.connection import broker_connection, unique_identifier
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings
from gateway.support.credentials import AccessToken
from gateway.viewer.gate import Door, Gate
from tests.patience import PATIENCE_S

if TYPE_CHECKING:
    from tests.fixtures.brokers import Mosquitto
    from tests.fixtures.poses import PoseSource

INFO = BridgeInfo(
    version="1.0",
    gateway="lab",
    reconstructor="joint",
    frame_rate=10,
    utc=UtcAnchor(t_ns=0, utc_ns=1_000, offset_ns=1_000, steps=0),
)


class Heard:
    """A fleet that receives what a test says."""

    def __init__(self, **options: Any) -> None:
        self.fleet = Fleet(**options)
        self.now_s = 100.0

    def say(self, topic: str, payload: bytes, is_retained: bool = False) -> None:
        self.fleet.take(
            f"mocap/{topic}",
            payload,
            is_retained=is_retained,
            now_s=self.now_s,
            utc_ns=round(self.now_s * 1e9) + 1_000,
        )

    def pose(self, seq: int, gateway: str = "lab", delay_s: float = 0.01) -> None:
        t_ns = round((self.now_s - delay_s) * 1e9)
        self.say(f"{gateway}/pose", orjson.dumps({"t_ns": t_ns, "seq": seq, "segments": {}}))

    def poses(self, numbers: range, gateway: str = "lab", delay_s: float = 0.01) -> None:
        for seq in numbers:
            self.now_s += 0.1
            self.pose(seq, gateway, delay_s)

    def online(self, gateway: str = "lab", info: BridgeInfo = INFO) -> None:
        self.say(f"{gateway}/bridge/state", b'{"state":"online"}', True)
        self.say(f"{gateway}/bridge/info", info.payload(), True)

    def row(self, which: int = 0) -> OverviewRow:
        return self.fleet.rows(self.now_s)[which]


def test_rate_loss_and_delay_are_those_of_the_last_seconds():
    heard = Heard(wearers={"lab": "anna"})
    heard.online()
    heard.poses(range(100))
    row = heard.row()
    assert (row.wearer, row.state, row.loss, row.alerts) == ("anna", "online", 0.0, ())
    assert row.rate_hz == pytest.approx(10, rel=0.15)
    assert row.delay_ms == pytest.approx(10, abs=0.5)


def test_lost_and_repeated_poses_are_counted_once():
    heard = Heard()
    heard.online()
    heard.poses(range(10))
    heard.poses(range(20, 30))  # ten are missing
    heard.now_s -= 0.5
    heard.poses(range(25, 30))  # and five come twice
    seen = heard.fleet.gateways["lab"]
    assert (seen.received, seen.lost, seen.repeated) == (20, 10, 5)
    assert "lost" in heard.row().alerts[0]


def test_a_gateway_that_begins_anew_has_lost_nothing():
    heard = Heard()
    heard.poses(range(50_000, 50_010))
    heard.poses(range(5))
    assert heard.fleet.gateways["lab"].lost == 0
    assert heard.fleet.gateways["lab"].received == 15


def test_alerts_say_what_is_wrong():
    heard = Heard()
    for name in ("a", "b", "c", "d"):
        heard.online(name)
    heard.say("a/bridge/state", b'{"state":"offline"}')
    health = BridgeHealth(
        t_ns=0,
        uptime_s=1,
        mqtt=OutputCounters(published=0, dropped=0, thinned=0, queued=0),
        same_name="ab",
        refused_topics=("mocap/b/pose",),
        statistics={"recording": {"free_mb": 900, "is_low": True}},
    )
    heard.say("b/bridge/health", health.payload())
    heard.say("c/bridge/info", INFO.model_copy(update={"version": "0.9"}).payload(), True)
    for module, version in ((1, "2.0"), (2, "2.1")):
        heard.say(f"c/module/{module}/state", orjson.dumps({"firmware": version}), True)
    heard.poses(range(10), "c")
    heard.poses(range(10), "d", delay_s=0.5)
    a, b, c, d = heard.fleet.rows(heard.now_s)
    assert a.alerts == ("offline",)
    assert {"online, but no poses come", "another gateway has the same name", "the disk is nearly full"} <= {
        *b.alerts
    }
    assert b.free_gb == 0.9
    assert c.alerts == ("version 0.9, others have 1.0", "modules with different firmware: 2.0, 2.1")
    assert d.alerts == ("poses are 500 ms late",)


def test_who_has_left_is_no_longer_shown_until_they_come_back():
    """Somebody before cameras takes off the broker what is kept of them; one who died stays offline."""
    heard = Heard()
    for name in ("lab", "lab_2"):
        heard.online(name)
        heard.poses(range(10), name)
    heard.say("lab/bridge/state", b'{"state":"offline"}')  # its will
    heard.say("lab_2/bridge/state", b'{"state":"offline"}')
    for below in ("bridge/info", "body", "bridge/state"):
        heard.say(f"lab_2/{below}", b"")
    heard.pose(10, "lab_2")  # was on its way, over another connection
    heard.say("lab_2/pose/late", b'{"t_ns":1,"seq":10}')
    heard.say("lab_2/module/1/state", b"")
    assert [(row.gateway, row.state) for row in heard.fleet.rows(heard.now_s)] == [("lab", "offline")]
    heard.online("lab_2")
    heard.poses(range(3), "lab_2")
    back = heard.row(1)
    assert (back.gateway, back.state, back.lost) == ("lab_2", "online", 0)


@pytest.mark.parametrize(
    "said",
    [
        ("lab/bridge/info", b"{"),
        ("lab/bridge/state", b"no json"),
        ("lab/pose", b'{"seq":1}'),
        ("lab/pose", b'{"t_ns":1e9,"seq":"x"}'),
        ("lab/module/1/state", b"[]"),
        ("nothing", b""),
    ],
)
def test_what_is_not_what_its_topic_promises_is_left_out(said: tuple[str, bytes]):
    heard = Heard()
    heard.say(*said)
    assert all(row.rate_hz == 0 for row in heard.fleet.rows(heard.now_s))


@pytest.fixture
def _has_brokers() -> None:
    try:
        clusters.program()
    except GatewayError as error:
        pytest.skip(str(error))


@pytest.mark.system
@pytest.mark.usefixtures("_has_brokers")
def test_the_demonstration_shows_all_gateways_on_a_page_that_names_no_stranger(
    command: Any, unused_port: int
):
    running = command("fleet", "demo", "--gateways", "6", "--rate", "10", "--page-port", str(unused_port))
    running.until_said(r"overview: http")
    where = f"http://127.0.0.1:{unused_port}"

    def rows() -> list[dict[str, Any]]:
        with urllib.request.urlopen(f"{where}/fleet.json", timeout=10) as answer:
            told: list[dict[str, Any]] = json.load(answer)
        return told

    running.until(lambda: sum(row["rate_hz"] > 5 for row in rows()) == 6, "six gateways send poses")
    assert [row["gateway"] for row in rows()] == [f"gw{n:03d}" for n in range(1, 7)]
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{where}/body?gateway=gw999", timeout=10)
    started = psutil.Process(running.pid).children(recursive=True)
    assert len(started) >= 4
    request = urllib.request.Request(where, headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request, timeout=10)
    running.terminate()
    running.wait()
    assert psutil.wait_procs(started, timeout=PATIENCE_S)[1] == []


@pytest.mark.system
async def test_who_leaves_goes_from_the_overview_and_who_dies_stays_offline(
    mosquitto: Mosquitto, pose_source: PoseSource, until: Callable[..., Awaitable[None]]
) -> None:
    """With one broker: a young cluster of NATS nodes loses a message now and then. `benchmarks fleet` counts
    retained messages and wills on three."""
    fleet, settings = Fleet(), MqttSettings(port=mosquitto.port)

    def states() -> dict[str, str]:
        return {row.gateway: row.state for row in fleet.rows(0.0)}

    receiver = listener(settings, take_into(fleet))
    listening = asyncio.create_task(receiver.run())
    await receiver.subscribed.wait()
    person = MqttOutput(settings, pose_source.skeleton, pose_source.info("ward"))
    person.leaves_nothing = True
    will = aiomqtt.Will("mocap/lab/bridge/state", b'{"state":"offline"}', 1, True)
    async with person:
        with contextlib.suppress(ConnectionResetError):
            async with broker_connection(settings, settings.port, unique_identifier("test"), will) as dying:
                await dying.publish("mocap/lab/bridge/state", b'{"state":"online"}', 1, True)
                await until(lambda: states() == {"lab": "online", "ward": "online"})
                raise ConnectionResetError
        await until(lambda: states() == {"lab": "offline", "ward": "online"})
    await until(lambda: states() == {"lab": "offline"})
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    later = Fleet()
    task = asyncio.create_task(listener(settings, take_into(later)).run())
    await until(lambda: [row.state for row in later.rows(0.0)] == ["offline"])
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


@pytest.mark.system
def test_no_broker_is_told_in_one_line(command: Any, unused_port: int):
    running = command("fleet", "list", "--port", str(unused_port))
    assert running.wait() == 1
    assert f"no MQTT broker at 127.0.0.1:{unused_port}" in running.errors


@pytest.mark.system
@pytest.mark.parametrize("width", [1280, 390], ids=["desktop", "phone"])
async def test_the_page_keeps_its_rows_and_fits_the_window(chromium: str, width: int):
    """Focus stays where it was when the rows are renewed; nothing is wider than the window."""
    shown_page = pytest.importorskip("tests.shown_page", reason="the extra 'viewer' is not installed")
    heard = Heard(wearers={"ward": "<b>Anna</b>"})
    heard.online("lab")
    heard.online("ward")
    heard.say("ward/bridge/state", b'{"state":"offline"}')
    gate_pass = AccessToken("the-pass-of-this-test")
    server = OverviewServer(
        lambda: as_plain(heard.fleet.rows(heard.now_s)), Bodies(MqttSettings()), gate_pass
    )
    async with (
        server,
        Gate("127.0.0.1", 0, server.port, Door(None), gate_pass=gate_pass) as gate,
        shown_page.browser_of(chromium) as browser,
    ):
        page = await shown_page.new_page(browser, (width, 800))
        await page.goto(f"http://127.0.0.1:{gate.port}")
        await page.get_by_text("2 gateways, 1 online, 2 with alerts").wait_for()
        await page.get_by_text("<b>Anna</b>").wait_for()
        await page.get_by_role("link", name="ward").focus()
        heard.online("aisle")
        heard.say("lab/bridge/state", b"")
        await page.get_by_text("2 gateways, 1 online, 2 with alerts").wait_for()
        await page.get_by_role("link", name="aisle").wait_for()
        assert await page.get_by_role("link").all_text_contents() == ["aisle", "ward"]
        assert await page.evaluate("document.activeElement.textContent") == "ward"
        assert await page.evaluate("document.documentElement.scrollWidth") == width
