"""The live page in a real browser, on a real broker."""

from __future__ import annotations

import asyncio
import json

import aiomqtt
import pytest

from devices.free_ports import free_port
from gateway.body.rig import load_rig
from gateway.contract.messages import BridgeState, PoseMessage, describe_body
from gateway.contract.topics import Topics
from gateway.outputs.settings import MqttSettings
from tests.patience import PATIENCE_S
from tests.shown_page import SIZES, TOKEN, browser_of, choose, new_page, open_tab, page_of
from tests.suit_service import GATEWAY, started, suit_config
from tests.typed_here import typed_here

pytestmark = pytest.mark.system
SKELETON = load_rig("suit_17").skeleton
LOOKING = "a-token-for-looking-only"


async def publish_poses(client, topics, is_ended):
    segments = dict.fromkeys(SKELETON.segment_names, tuple(SKELETON.neutral))
    status = dict.fromkeys(SKELETON.segment_names, "measured") | {"left_shank": "missing"}
    for k in range(100_000):
        if is_ended.is_set():
            return
        pose = PoseMessage(
            t_ns=k, seq=k, frame="ENU", order="wxyz", root="pelvis", segments=segments, status=status
        )
        await client.publish(topics.pose, pose.payload())
        await asyncio.sleep(0.05)


async def test_the_page_shows_a_moving_body_and_says_when_nothing_comes(mosquitto, unused_port, chromium):
    settings = MqttSettings(port=mosquitto.port)
    topics = Topics("mocap", GATEWAY)
    is_ended = asyncio.Event()
    async with aiomqtt.Client("127.0.0.1", mosquitto.port) as client:
        await client.publish(topics.bridge_state, BridgeState(state="online").payload(), retain=True)
        await client.publish(topics.body, describe_body(SKELETON).payload(), retain=True)
        publishing = asyncio.create_task(publish_poses(client, topics, is_ended))
        async with page_of(settings, unused_port, chromium) as (page, requested):
            await page.get_by_text(f"{GATEWAY}: online").wait_for()
            assert await page.locator("canvas").count() >= 1
            await page.get_by_text("start", exact=True).click()
            await page.get_by_text("Recording, start").wait_for()
            is_ended.set()
            await page.get_by_text("NO DATA for").wait_for()
            assert requested
            assert {url for url in requested if "127.0.0.1" not in url and not url.startswith("data:")} <= {
                url for url in requested if url.startswith("blob:")
            }
        await publishing


def test_no_address_is_printed_where_there_is_no_broker():
    code, output, errors = typed_here(["view", "--port", free_port(), "--page-port", free_port()])
    assert (code, output) == (1, "")
    assert "no MQTT broker" in errors


async def test_on_a_phone_a_tab_begins_right_below_the_tabs(mosquitto, unused_port, chromium):
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium, (390, 844)) as (page, _):
        await open_tab(page, "Plot")
        chooser = page.locator("input[role=combobox]").filter(visible=True).first
        await chooser.wait_for()
        tabs, first = await page.get_by_role("tablist").bounding_box(), await chooser.bounding_box()
        assert first["y"] - (tabs["y"] + tabs["height"]) < 40
        assert await page.get_by_role("button", name="mark", exact=True).filter(visible=True).count() == 0


async def test_a_gateway_that_has_no_suit_yet_is_shown_and_where_to_begin(
    mosquitto, unused_port, chromium, command
):
    """The body stands there from the first look on, whichever gateway it is."""
    topics = Topics("mocap", GATEWAY)
    async with aiomqtt.Client("127.0.0.1", mosquitto.port) as client:
        await client.publish(topics.bridge_state, BridgeState(state="online").payload(), retain=True)
        await client.publish(topics.body, describe_body(SKELETON).payload(), retain=True)
        view = command("view", "--port", mosquitto.port, "--page-port", unused_port)
        await view.until_it_says("live page")
        async with browser_of(chromium) as browser:
            page = await new_page(browser)
            await page.goto(f"http://127.0.0.1:{unused_port}")
            await page.get_by_text(f"{GATEWAY}: online; no pose has come yet").wait_for()
            await page.get_by_text("begin with 1–3 Suit").wait_for()


async def test_who_may_only_look_finds_no_button_that_asks_anything(
    mosquitto, unused_port, chromium, command, tmp_path
):
    for name, token in (("writing", TOKEN), ("looking", LOOKING)):
        (tmp_path / name).write_text(token)
    topics = Topics("mocap", GATEWAY)
    tokens = ["--token-file", tmp_path / "writing", "--looking-token-file", tmp_path / "looking"]
    where = ["--port", mosquitto.port, "--gateway", GATEWAY, "--page-port", unused_port]
    async with aiomqtt.Client("127.0.0.1", mosquitto.port) as client:
        await client.publish(topics.bridge_state, BridgeState(state="online").payload(), retain=True)
        await client.publish(topics.body, describe_body(SKELETON).payload(), retain=True)
        view = command("view", *where, *tokens)
        await view.until_it_says("live page")
        async with browser_of(chromium) as browser:
            for token, buttons in ((LOOKING, 0), (TOKEN, 1)):
                page = await new_page(browser)
                await page.goto(f"http://127.0.0.1:{unused_port}/?token={token}")
                await page.get_by_text(f"{GATEWAY}: online").wait_for()
                for button in ("start", "stop", "heading", "full", "mounting", "position"):
                    assert await page.get_by_role("button", name=button, exact=True).count() == buttons
                assert await page.get_by_role("button", name="front", exact=True).count() == 1


@pytest.mark.parametrize("size", SIZES, ids=["desktop", "phone"])
async def test_modules_that_share_an_id_are_set_up_on_the_page(
    mosquitto, unused_port, chromium, command, tmp_path, size
):
    """Heard, told apart, given ids, assigned and taken back, without a terminal."""
    await started(command, tmp_path, mosquitto.port, "arm_3", "--id-conflict", allow_device_writes=True)
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium, size) as (page, _):
        await page.get_by_text(f"{GATEWAY}: online").wait_for()
        await page.get_by_role("tab", name="1–3 Suit").click()
        await page.get_by_role("button", name="Look for modules").click()
        await page.get_by_text("2 modules have id").wait_for()
        await page.get_by_text("devices heard").wait_for()  # which moves what is below it
        separate = page.get_by_role("button", name="Give them ids of their own")
        await separate.click()
        await page.get_by_text("Nothing is written yet").wait_for()
        await page.get_by_role("checkbox", name="Write to the modules").click()
        await separate.click()
        await page.get_by_text("modules that have ids of their own now").wait_for()
        await page.get_by_text("2 modules have id").wait_for(state="detached")
        await choose(page, 0, "63 · ")
        await choose(page, 1, "right forearm")
        assign = page.get_by_role("button", name="Assign", exact=True)
        await assign.click()
        await page.get_by_text("written: right forearm: module 63 becomes 9").wait_for()
        await page.get_by_text("not heard:").wait_for(state="detached")
        await page.get_by_role("button", name="Take back").click()
        await page.get_by_text("not heard: right forearm").wait_for()
        await page.get_by_role("button", name="Take back").click()
        await page.get_by_text("taken back, changes: 1").wait_for()
        await page.get_by_text("2 modules have id").wait_for()
        await open_tab(page, "View")
        await choose(page, 0, "Deutsch")
        await page.get_by_text(f"{GATEWAY}: in Betrieb").wait_for()
        await open_tab(page, "1–3 Anzug")
        await page.get_by_role("button", name="Module suchen").wait_for()
        await page.get_by_text("nicht gehört: rechter Unterarm").wait_for()


async def test_a_body_is_calibrated_on_the_page(
    mosquitto, unused_port, chromium, command, tmp_path, monkeypatch
):
    """The steps with what to do and how long, a score for each module; a step again; and in use."""
    monkeypatch.chdir(tmp_path)
    await started(command, tmp_path, mosquitto.port, "suit_lower_7", "--strap-on", "random")
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium) as (page, _):
        await page.get_by_text(f"{GATEWAY}: online").wait_for()
        await page.get_by_role("tab", name="5 Body").click()
        step = page.get_by_role("button", name="Do this step")
        assert await step.count() == 0  # what cannot be done yet is not offered
        await page.get_by_role("button", name="Begin with the poses").click()
        await page.get_by_text("steps: do them one after another").wait_for()
        await step.click()
        await page.get_by_text("Begins in").wait_for()
        await page.get_by_text("Hold on for").wait_for()
        await page.get_by_text("done: N pose").wait_for()
        await page.get_by_role("button", name="Work out how modules sit").click()
        await page.get_by_text("of 7 modules are good").wait_for()
        assert await page.get_by_role("cell", name="left thigh", exact=True).count() == 1


@pytest.mark.parametrize(
    ("maker", "medium", "rig", "method", "more"),
    [
        ("ximu3", "udp", "arm_3", "joint", []),
        ("mti", "pty", "arm_3", "joint", []),
        ("mti_can", "slcan", "arm_3", "joint", []),
        ("slimevr", "udp", "arm_3", "joint", []),
        ("witmotion", "pty", "arm_3", "joint", []),
        ("witmotion_can", "slcan", "arm_3", "joint", []),
        ("mvn", "tcp", "mvn_17", "joint", []),
        ("mvn", "udp", "mvn_fused_23", "fused", ["--mode", "fused"]),
        ("bno08x_rvc", "pty", "arm_3", "fused_neutral", []),
        ("mocopi", "udp", "mocopi_23", "fused", []),
    ],
)
async def test_a_body_that_modules_of_another_maker_move_is_seen_subscribed_to_and_replayed(
    mosquitto, unused_port, chromium, command, tmp_path, maker, medium, rig, method, more
):
    """On the page in a browser, by a subscriber that is none of ours, and bit for bit from the recording."""
    where = ["--link", tmp_path / "imu"] if medium in ("pty", "slcan") else ["--port", free_port()]
    emulated = command("emulate", "--speaks", maker, "--rig", rig, "--on", medium, *where, *more, "--json")
    links = json.loads(await emulated.until_it_says('"links"'))["links"]
    config = suit_config(tmp_path, mosquitto.port, rig, links=links, reconstructor=method)
    gateway = command("record", "-c", config, "--folder", tmp_path, "--name", "walk", "--quiet")
    small = (700, 450)  # every pixel is drawn on the processor, which the gateway needs too
    async with page_of(MqttSettings(port=mosquitto.port), unused_port, chromium, small) as (page, _):
        await page.get_by_text(f"{GATEWAY}: online").wait_for()
        seen = await picture_of(page)
        async with asyncio.timeout(PATIENCE_S):
            while await picture_of(page) == seen:
                await asyncio.sleep(0.2)
        assert await subscriber_sees_motion(mosquitto.port)
        gateway.terminate()
        await gateway.ended()
        await page.get_by_text("NO DATA for").or_(page.get_by_text("offline")).first.wait_for()
        still = None
        async with asyncio.timeout(PATIENCE_S):  # what moved was the body
            while (seen := await picture_of(page)) != still:
                still = seen
                await asyncio.sleep(0.5)
    emulated.terminate()
    (recorded,) = tmp_path.glob("*walk.mcap")
    verified = command("replay", recorded, "--verify")
    assert await verified.ended() == 0
    assert "identical" in verified.output


async def picture_of(page):
    """What the page shows left of its panel, which tells times."""
    return await page.screenshot(clip={"x": 0, "y": 100, "width": 350, "height": 350})


async def subscriber_sees_motion(port):
    """Whether some segment turns, within the patience of a test, for one who knows the topics alone."""
    first = {}
    async with asyncio.timeout(PATIENCE_S), aiomqtt.Client("127.0.0.1", port) as client:
        await client.subscribe(f"mocap/{GATEWAY}/pose")
        async for message in client.messages:
            segments = json.loads(message.payload)["segments"]
            known = {name: q_wb for name, q_wb in segments.items() if q_wb is not None}
            both = known.keys() & first.keys()
            if any(
                abs(now - then) > 0.05
                for name in both
                for now, then in zip(known[name], first[name], strict=True)
            ):
                return True
            first = known | first
    return False
