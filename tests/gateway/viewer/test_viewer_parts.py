"""What the page draws, without a page."""

from __future__ import annotations

import asyncio
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.body.bones import BONE_FACES, BONE_VERTICES, bones_of
from gateway.body.kinematics import joint_positions, lowest_point
from gateway.body.mannequin import SPINDLE_FACES, SPINDLE_VERTICES, mannequin_of
from gateway.body.rig import load_rig
from gateway.contract.messages import (
    BridgeHealth,
    BridgeInfo,
    ModuleInfo,
    OutputCounters,
    PoseMessage,
    describe_body,
)
from gateway.frames import Status
from gateway.geometry import quaternion
from gateway.outputs.settings import MqttSettings
from gateway.viewer.appearance import (
    COLOURS,
    STALE,
    UNSURE,
    legend,
    segment_colours,
    side_of,
    silent_segments,
    status_summary,
)
from gateway.viewer.module_table import (
    RecentLosses,
    clock_of,
    health_line,
    module_rows,
    module_table,
    recorded_rows,
    warnings_of,
)
from gateway.viewer.pace import pictures
from gateway.viewer.pose_table import bend_deg
from gateway.viewer.posture import LASTS_S, LastingStatus, PostureKeeper, skeleton_of
from gateway.viewer.series_plot import History
from gateway.viewer.texts import translated
from tests.simulated_time import in_simulated_time

SKELETON = load_rig("suit_17").skeleton


def pose(**changes):
    segments = dict.fromkeys(SKELETON.segment_names, (1.0, 0.0, 0.0, 0.0))
    status = dict.fromkeys(SKELETON.segment_names, "measured")
    fields = {"t_ns": 1, "seq": 1, "frame": "ENU", "order": "wxyz", "root": "pelvis"}
    fields |= {"segments": segments, "status": status} | changes
    return PoseMessage(**fields)


def test_every_bone_ends_at_its_tip_or_at_a_joint_that_its_segment_carries():
    bones = bones_of(SKELETON)
    assert set(bones.segment) == set(range(SKELETON.n_segments))
    for s, q, scale in zip(bones.segment, bones.q_segment_from_bone, bones.scale, strict=True):
        end = quaternion.rotate(q, np.array([scale[0], 0.0, 0.0]))
        ends = [SKELETON.tips[s], *SKELETON.offsets[SKELETON.parents == s]]
        assert min(np.linalg.norm(end - candidate) for candidate in ends) < 1e-9


def test_the_bone_is_closed_and_its_faces_look_outwards():
    edges = {(a, b) for face in BONE_FACES for a, b in zip(face, np.roll(face, -1), strict=True)}
    assert edges == {(b, a) for a, b in edges}
    middle = np.array([0.2, 0.0, 0.0])
    for a, b, c in BONE_VERTICES[BONE_FACES]:
        assert np.dot(np.cross(b - a, c - a), a - middle) > 0


def test_a_body_whose_place_nobody_knows_stands_on_the_floor():
    keeper = PostureKeeper(SKELETON)
    q_wb = tuple(SKELETON.neutral)
    drawn = keeper.take(pose(segments=dict.fromkeys(SKELETON.segment_names, q_wb)))
    assert lowest_point(SKELETON, drawn.q_wb, drawn.p_w) == pytest.approx(0.0, abs=1e-12)


def test_a_known_place_is_kept():
    keeper = PostureKeeper(SKELETON)
    drawn = keeper.take(pose(position={"pelvis": (1.0, 2.0, 3.0)}))
    expected = joint_positions(SKELETON.parents, SKELETON.offsets, drawn.q_wb, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(drawn.p_w, expected)


def test_a_segment_that_falls_silent_stays_as_it_was():
    keeper = PostureKeeper(SKELETON)
    turned = (math.cos(0.4), math.sin(0.4), 0.0, 0.0)
    segments = dict.fromkeys(SKELETON.segment_names, (1.0, 0.0, 0.0, 0.0))
    keeper.take(pose(segments=segments | {"head": turned}))
    drawn = keeper.take(pose(segments=segments | {"head": None}))
    np.testing.assert_allclose(drawn.q_wb[SKELETON.index("head")], turned)


def test_the_published_skeleton_is_read_back():
    read = skeleton_of(describe_body(SKELETON))
    assert read.segment_names == SKELETON.segment_names
    np.testing.assert_array_equal(read.parents, SKELETON.parents)
    np.testing.assert_array_equal(read.offsets, SKELETON.offsets)
    np.testing.assert_array_equal(read.tips, SKELETON.tips)


def test_colours_tell_status_and_confidence():
    colours = segment_colours(
        ["measured", "measured", "missing"], [math.radians(1.0), math.radians(40.0), None], is_stale=False
    )
    assert [tuple(row) for row in colours] == [COLOURS["measured"], UNSURE, COLOURS["missing"]]
    assert {tuple(row) for row in segment_colours(["measured"] * 3, [None] * 3, is_stale=True)} == {STALE}
    assert all(name.replace("_", " ") in legend() for name in COLOURS)


def test_left_and_right_are_told_apart_and_no_sigma_looks_like_another_status():
    names = ["left_hand", "right_hand", "head"]
    sides = [side_of(name) for name in names]
    assert sides == ["left", "right", "trunk"]
    sure = segment_colours(["measured"] * 3, [0.0] * 3, False, sides)
    assert len({tuple(row) for row in sure}) == 3
    others = np.array([colour for name, colour in COLOURS.items() if name != "measured"], float)
    for degrees in np.linspace(0.0, 20.0, 41):
        shown = segment_colours(["measured"] * 3, [math.radians(degrees)] * 3, False, sides).astype(float)
        apart = np.linalg.norm(shown[:, None] - others[None], axis=2)
        assert apart.min() > 60.0


def test_the_mannequin_has_volume_and_a_face_in_front():
    figure = mannequin_of(SKELETON)
    assert set(figure.segment) == set(range(SKELETON.n_segments))
    assert figure.half.min() > 0.01
    face = figure.side.index("face")
    head = [i for i, s in enumerate(figure.segment) if s == SKELETON.index("head") and i != face]
    assert figure.centre[face, 0] > max(figure.centre[i, 0] for i in head) + 0.03  # x is anterior
    assert [SKELETON.segment_names[s] for s in figure.soles] == ["left_foot", "right_foot"]
    assert mannequin_of(load_rig("robot_arm_4").skeleton) is None


def test_a_limb_of_the_mannequin_is_closed_and_its_faces_look_outwards():
    edges = {(a, b) for face in SPINDLE_FACES for a, b in zip(face, np.roll(face, -1), strict=True)}
    assert edges == {(b, a) for a, b in edges}
    for a, b, c in SPINDLE_VERTICES[SPINDLE_FACES]:
        assert np.dot(np.cross(b - a, c - a), (a + b + c) / 3.0) > 0


def health_of(t_ns, received, lost):
    return BridgeHealth(
        t_ns=t_ns,
        uptime_s=1,
        mqtt=OutputCounters(published=0, dropped=0, thinned=0, queued=0, connections=1),
        statistics={"modules": {"1": {"received": received, "lost": lost}}},
    )


def test_much_loss_and_great_latency_are_warned_of():
    losses = RecentLosses()
    for second, (received, lost) in enumerate([(100, 0), (200, 0), (276, 24)]):
        losses.add(health_of(second * 10**9, received, lost))
        losses.add(None)
    assert losses.share == pytest.approx(24 / 200)
    assert "12%" in warnings_of(losses.share, 0.01)[0]
    assert warnings_of(0.0, 2.0) == (
        "poses are 2.0 s late: the gateway, the broker or the network is too busy",
    )
    assert warnings_of(0.001, 0.02) == ()
    for second in range(3, 20):  # what was lost long ago is no warning for ever
        losses.add(health_of(second * 10**9, 276 + 100 * second, 24))
    assert losses.share == 0.0
    losses.add(health_of(30 * 10**9, 5, 0))  # the gateway was started anew
    assert losses.share == 0.0


def test_a_recording_is_told_by_its_clock():
    assert [clock_of(s) for s in (None, 5.9, 65, 3725)] == ["0:00", "0:05", "1:05", "1:02:05"]


def test_the_table_of_a_recording_says_how_much_was_measured():
    status = np.array([[int(Status.MEASURED), int(Status.MISSING)]] * 3 + [[int(Status.MEASURED)] * 2])
    assert recorded_rows(["head", "left_hand"], status) == [
        ("head", "100.0", "0.0", "0.0"),
        ("left hand", "25.0", "0.0", "75.0"),
    ]


def test_segments_of_silent_modules_are_told_by_name():
    status = {"pelvis": "measured", "l5": "predicted", "head": "predicted", "left_hand": "missing"}
    silent = silent_segments(status, {"pelvis", "head", "left_hand"})
    assert silent == ("head", "left_hand")  # l5 bears no module: it is predicted by nature
    summary = status_summary(status, silent)
    assert summary == "1 measured, 2 predicted, 1 missing; no data of head, left hand"
    assert status_summary({"a": "measured", "b": "measured"}, ()) == "all 2 segments measured"
    many = [f"s{k}" for k in range(9)]
    assert status_summary(dict.fromkeys(many, "missing"), many).endswith("of s0, s1, s2, …")


def test_pictures_come_at_their_rate_and_late_ones_are_not_made_up_for():
    async def drawn():
        elapsed = []
        async for since_s in pictures(50.0):
            elapsed.append(since_s)
            if len(elapsed) == 3:
                await asyncio.sleep(0.1)
            if len(elapsed) == 8:
                break
        return elapsed

    assert in_simulated_time(drawn()) == pytest.approx([0.0, 0.02, 0.02, 0.1, 0.02, 0.02, 0.02, 0.02])


def test_history_forgets_what_is_old_and_begins_anew_when_time_jumps_back():
    history = History(("a", "b"), span_s=1.0)
    assert all(len(array) == 1 for array in history.arrays())
    for k in range(31):
        history.add(0.1 * k, (k, -k))
    times, a, b = history.arrays()
    assert times[0] == pytest.approx(-1.0)
    assert times[-1] == 0.0
    np.testing.assert_array_equal(a, -b)
    assert a[-1] == 30
    history.add(0.0, (7, 8))
    assert [array.tolist() for array in history.arrays()] == [[0.0], [7.0], [8.0]]


def test_the_module_table_names_the_silent_and_the_lossy():
    info = BridgeInfo(
        version="1",
        gateway="g",
        reconstructor="independent",
        frame_rate=100,
        modules=(ModuleInfo(module=1, segment="head"), ModuleInfo(module=2, segment="<b>")),
    )
    summary = {"received": 90, "lost": 10, "clock_ppm": -12.34, "residual_us": 56.0, "battery_percent": 77}
    health = BridgeHealth(
        t_ns=1,
        uptime_s=1,
        mqtt=OutputCounters(published=0, dropped=0, thinned=0, queued=0, connections=1),
        statistics={"modules": {"1": summary}, "doubts": {"2": "worn <upside> down"}},
    )
    rows = module_rows(health, info)
    assert rows == [
        ("1", "head", "77 %", "10.00", "-12.3", "56", translated("en", "remedy_lossy")),
        ("2", "<b>", "", "silent", "", "", translated("en", "remedy_silent", tab="1–3 Suit")),
    ]
    table = module_table(rows)
    assert table.count("color:var(--mocap-poor)") == 4
    assert "charge it" in table
    assert "<b>" not in table
    assert module_rows(health, info, silent=["head"])[0][3] == "silent"
    assert module_rows(None, None) == []
    good = {**summary, "lost": 0}
    statistics = {"modules": {"1": good, "2": good}, "doubts": {"2": "worn <upside> down"}}
    rows = module_rows(health.model_copy(update={"statistics": statistics}), info)
    assert [row[-1] for row in rows] == ["", "worn <upside> down"]
    assert "worn &lt;upside&gt; down" in module_table(rows)


def test_the_strip_tells_modules_losses_and_disk():
    assert health_line(17, 1, 0.0021, {"free_mb": 80_900}) == "16 of 17 modules, 0.2 % lost, 80.9 GB free"
    assert health_line(0, 0, 0.0, {}) == "0.0 % lost"
    assert "nearly full" in warnings_of(0.0, 0.0, {"is_low": True})[0]


def test_a_recording_that_ended_by_itself_is_warned_of():
    """Its red light only goes out, while whoever wears the suit believes that it goes on."""
    (told,) = warnings_of(0.0, 0.0, {"state": "off", "ended": "No space left on device", "is_low": True})
    assert "ended by itself: No space left on device" in told
    assert warnings_of(0.0, 0.0, {"state": "off", "ended": "stopped"}) == ()
    assert warnings_of(0.0, 0.0, {"state": "recording"}) == ()


def test_a_page_that_tells_its_size_late_or_is_turned_is_looked_at_anew(unused_port):
    """On a busy machine a phone's page seemed wide at first, and showed half of the body."""
    viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    from gateway.viewer.stage import ViewerStage  # noqa: PLC0415 - needs the extra

    server = viser.ViserServer("127.0.0.1", unused_port, verbose=False)
    try:
        stage, updated = ViewerStage(server), []
        camera = SimpleNamespace(aspect=1.8, on_update=updated.append)
        stage._welcome(SimpleNamespace(client_id=7, camera=camera))
        wide = camera.position
        updated[0](camera)
        assert camera.position is wide  # whoever turns the view keeps it
        camera.aspect = 0.5
        updated[0](camera)
        assert np.linalg.norm(camera.position[:2]) > 1.4 * np.linalg.norm(wide[:2])
    finally:
        server.stop()


def test_a_bend_is_none_in_the_neutral_posture_and_grows_with_the_turn():
    turned = (math.cos(math.radians(20)), 0.0, 0.0, math.sin(math.radians(20)))
    assert bend_deg((1.0, 0.0, 0.0, 0.0), turned) == pytest.approx(40.0)
    assert bend_deg(turned, turned) == pytest.approx(0.0, abs=1e-5)
    assert math.isnan(bend_deg(None, turned))


def test_a_body_far_away_stands_in_the_middle_and_so_does_its_name(unused_port):
    viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    from gateway.viewer.scene import BodyScene  # noqa: PLC0415 - needs the extra
    from gateway.viewer.stage import SECTION_M, ViewerStage  # noqa: PLC0415

    server = viser.ViserServer("127.0.0.1", unused_port, verbose=False)
    try:
        stage = ViewerStage(server)
        scene = BodyScene(server, stage, SKELETON)
        drawn = PostureKeeper(SKELETON).take(pose(position={"pelvis": (100.25, -40.5, 1.0)}))
        stage.follow(drawn.place, 7.0)
        scene.draw(drawn, is_stale=False, silent=["head"])
        np.testing.assert_allclose(stage.middle, [100.25, -40.5, 0.0])
        nodes = server.scene._handle_from_node_name
        assert np.abs(nodes["/body/mannequin"].batched_positions[:, :2]).max() < 2.0
        assert np.linalg.norm(nodes["/body/names/head"].position) < 2.5
        assert nodes["/body/names/head"].text == "head: no data"
        assert not nodes["/body/names/pelvis"].visible
        np.testing.assert_allclose(nodes["/floor"].position, [-0.25, -(-40.5 % SECTION_M), 0.0], atol=1e-9)
        stage.follow(drawn.place + np.array([1.0, 0.0, 0.0]), 7.05)
        assert 100.25 < stage.middle[0] < 101.0  # smoothly from now on
    finally:
        server.stop()


@pytest.mark.parametrize("pictures_hz", [2.0, 60.0])
def test_a_body_that_walks_stays_in_view_however_few_pictures_are_drawn(pictures_hz, unused_port):
    viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    from gateway.viewer.stage import ViewerStage  # noqa: PLC0415 - needs the extra

    server = viser.ViserServer("127.0.0.1", unused_port, verbose=False)
    try:
        stage, speed_m_s = ViewerStage(server), 1.5
        for time_s in np.arange(0.0, 10.0, 1.0 / pictures_hz):
            place = np.array([speed_m_s * time_s, 0.0, 1.0])
            stage.follow(place, time_s)
        assert place[0] - stage.middle[0] < 0.5
        stage.follow(np.zeros(3), 0.0)  # a recording that begins again
        assert stage.middle[0] == 0.0
    finally:
        server.stop()


async def test_a_body_stands_on_the_floor_before_any_pose_has_come(unused_port):
    viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    from gateway.viewer.live import LiveViewer  # noqa: PLC0415 - needs the extra

    server = viser.ViserServer("127.0.0.1", unused_port, verbose=False)
    try:
        viewer = LiveViewer(server, MqttSettings(), "lab")
        viewer._take_body(describe_body(SKELETON))
        joints = server.scene._handle_from_node_name["/body/mannequin"].batched_positions
        assert 0.0 <= joints[:, 2].min() < 0.2
        assert joints[:, 2].max() > 1.2, "it stands"
        assert np.abs(joints[:, :2]).max() < 1.0, "where cameras look"
    finally:
        server.stop()


def test_a_trail_keeps_the_last_seconds_and_goes_when_it_is_not_wanted(unused_port):
    viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    from gateway.viewer.stage import ViewerStage  # noqa: PLC0415 - needs the extra
    from gateway.viewer.trail import SPACING_S, SPAN_S, Trail  # noqa: PLC0415 - needs the extra

    server = viser.ViserServer("127.0.0.1", unused_port, verbose=False)
    try:
        trail = Trail(server, ViewerStage(server))
        for time_s in np.arange(0.0, 2 * SPAN_S, 0.01):
            trail.draw(True, time_s, np.array([time_s, 0.0, 1.0]))
        points = trail._points.points
        assert abs(len(points) - SPAN_S / SPACING_S) <= 2
        assert points[-1, 0] > 2 * SPAN_S - 2 * SPACING_S
        assert (points[:, 2] < 0.01).all()
        trail.draw(False, 2 * SPAN_S, np.zeros(3))
        assert trail._points is None
        trail.draw(True, 0.0, np.zeros(3))
        assert len(trail._points.points) == 1
    finally:
        server.stop()


@given(st.lists(st.floats(-2, 2), max_size=20))
def test_names_stand_apart_in_their_order_and_are_moved_no_more_than_need_be(heights):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    from gateway.viewer.scene import apart  # noqa: PLC0415 - needs the extra

    moved = apart(heights, 0.1)
    order = np.argsort(heights, kind="stable")
    gaps = np.diff(np.array(moved)[order])
    assert (gaps > 0.1 - 1e-9).all()
    if (np.diff(np.sort(heights)) >= 0.1).all():
        np.testing.assert_allclose(moved, heights, atol=1e-12)
    if heights:
        assert np.mean(moved) == pytest.approx(np.mean(heights), abs=1e-9)


def test_one_lost_sample_lets_no_limb_flash_and_what_lasts_is_shown():
    lasting, step_ns = LastingStatus(2), round(LASTS_S * 1e9 / 10)
    assert lasting.take(0, ["measured", "missing"]) == ("measured", "missing")  # the first is shown as it is
    assert lasting.take(step_ns, ["interpolated", "missing"])[0] == "measured"
    assert lasting.take(2 * step_ns, ["measured", "missing"])[0] == "measured"
    shown = [lasting.take(k * step_ns, ["predicted", "predicted"]) for k in range(3, 15)]
    assert [status for status, _ in shown] == ["measured"] * 10 + ["predicted"] * 2
    assert {status for _, status in shown} == {"predicted"}  # from one that is not measured to another
    assert lasting.take(15 * step_ns, ["measured", "held"]) == ("measured", "held")
    lasting.take(16 * step_ns, ["held", "held"])
    assert lasting.take(0, ["held", "held"])[0] == "held"  # a recording begins anew
