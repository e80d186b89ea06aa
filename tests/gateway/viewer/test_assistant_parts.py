"""What the set-up assistant says, without a page."""

from __future__ import annotations

import asyncio
import string

import pytest

from devices.calibration_script import timetable
from gateway.body.body_file import load_body
from gateway.calibration.movement_check import MOVEMENTS
from gateway.calibration.procedure import PROCEDURE
from gateway.errors import GatewayError
from gateway.modules.assignment import Wardrobe
from gateway.viewer.assistant import conflict_lines, devices_of, findings, found_table, proposal_text
from gateway.viewer.body_steps import instruction_of, progress, result_table
from gateway.viewer.module_table import RecordingStatus
from gateway.viewer.sensor_tab import result_table as sensor_table
from gateway.viewer.step_pictures import step_picture
from gateway.viewer.step_tab import Errands
from gateway.viewer.takes import takes_list
from gateway.viewer.texts import LANGUAGES, movement_name, texts, translated


def device(module, unique_id, segment, **more):
    return {
        "module": module,
        "unique_id": unique_id,
        "segment": segment,
        "answers": True,
        "battery_percent": 80,
        "rate_hz": 100.0,
        "loss_percent": 0.25,
        "clock": {"residual_us": 41.0},
    } | more


FIRST, SECOND, THIRD = "aa" * 12, "bb" * 12, "cc" * 12
LISTED = {
    "modules": [
        device(0, FIRST, "upper_arm"),
        device(1, SECOND, "<b>"),
        device(7, None, None, answers=False, battery_percent=None, loss_percent=None, clock=None),
    ],
    "conflicts": [],
    "segments": {"upper_arm": 0, "<b>": 1, "hand": 2},
}


def placeholders(text):
    return {name for _, name, _, _ in string.Formatter().parse(text) if name}


@pytest.mark.parametrize("language", LANGUAGES.values())
def test_every_language_says_everything_with_the_same_values(language):
    english = texts("en")
    assert texts(language).keys() == english.keys()
    for key, text in texts(language).items():
        assert placeholders(text) == placeholders(english[key]), key
        assert text.strip()


def test_languages_differ():
    same = [key for key, text in texts("de").items() if text == texts("en")[key]]
    assert set(same) <= {"clock", "is_asked", "metres", "playback_pause", "rate", "signal", "went_wrong"}


def test_only_devices_that_answer_can_be_chosen():
    assert list(devices_of(LISTED, "en").values()) == [FIRST, SECOND]
    assert next(iter(devices_of(LISTED, "en"))) == "0 · upper arm · …aaaaaa"


def test_a_device_is_called_by_its_segment_in_every_language():
    listed = LISTED | {"modules": [device(5, FIRST, "left_forearm")]}
    assert list(devices_of(listed, "de")) == ["5 · linker Unterarm · …aaaaaa"]


@pytest.mark.parametrize("language", LANGUAGES.values())
def test_the_table_names_who_is_silent_and_who_shares_an_id(language):
    table = found_table(LISTED, language)
    assert "80\u00a0%" in table
    assert translated(language, "silent") in table
    assert translated(language, "missing", segments="hand") in table
    assert "<b>" not in table
    shared = LISTED | {"conflicts": [{"module": 1, "unique_ids": [SECOND, THIRD]}]}
    (line,) = conflict_lines(shared, language)
    assert "…bbbbbb, …cccccc" in line
    assert "…bbbbbb, …cccccc" in found_table(shared, language)


def test_what_would_be_written_is_told_before():
    wardrobe = Wardrobe(LISTED)
    assert proposal_text(wardrobe.propose("upper_arm", FIRST), "en") == "upper arm: it is module 0 already"
    assert proposal_text(wardrobe.propose("hand", FIRST), "en") == "hand: module 0 becomes 2"
    exchange = proposal_text(wardrobe.propose("<b>", FIRST), "en")
    assert exchange == "<b>: module 0 becomes 1, and the one that is 1 becomes 0"


def status_of(phase, **modules):
    return {
        "phase": phase,
        "left_s": 2.6,
        "done": [],
        "modules": [
            {"segment": name, "heard": heard, "still": still, "turning_deg_s": 1.0}
            for name, (heard, still) in modules.items()
        ],
    }


def test_progress_tells_what_to_do_for_how_long_and_who_spoils_it():
    status = status_of("recording n_pose", head=(True, True), left_hand=(True, False), pelvis=(False, False))
    said = progress(status, "Stand still", "en")
    assert said == "Stand still. Hold on for 3 s · not heard: pelvis · not still: left hand"
    ready = progress(status_of("get ready for squat", head=(True, False)), "Squat", "de")
    assert ready == "Squat. Beginnt in 3 s"  # in a movement nobody has to be still


@pytest.mark.parametrize("language", LANGUAGES.values())
def test_every_step_of_the_gateway_has_its_instruction(language):
    for step in PROCEDURE:
        assert instruction_of(step.name, "?", language) != "?"
    assert instruction_of("dance", "as told", language) == "as told"


def test_the_result_names_reasons():
    module = {"module": 3, "segment": "left_foot", "score": 0.31, "quality": "poor", "reasons": ["a < b"]}
    table = result_table({"modules": [module]}, "en")
    assert "0.31" in table
    assert "a &lt; b" in table


TAKE = {
    "file": "a<b>.mcap",
    "begun_utc_ns": 1_700_000_000_000_000_000,
    "duration_s": 65.0,
    "bytes": 2_000_000,
    "loss_percent": 3.0,
    "defect": None,
    "exports": ["a.bvh"],
    "outline": [[0.0, 0.0, 0.1, 0.5]],
}


def test_a_take_is_told_with_its_length_size_loss_and_picture():
    shown = takes_list({"recordings": [TAKE], "problems": ["<bad>"], "free_mb": 1500}, "en")
    for part in (
        "1:05",
        "2.0 MB",
        "3.00 % lost",
        "a.bvh",
        "1.5 GB free",
        "<svg",
        "&lt;bad&gt;",
        "a&lt;b&gt;",
    ):
        assert part in shown
    assert "<b>a<b>" not in shown


def test_the_worst_finding_comes_first_and_says_what_to_do():
    found = [
        {"subject": "rig", "verdict": "good", "found": "<17>", "remedy": ""},
        {"subject": "disk", "verdict": "bad", "found": "full", "remedy": "make room"},
    ]
    shown = findings({"findings": found, "ports": [{"name": "/dev/ttyUSB0", "link": None}]}, "en")
    assert shown.index("disk") < shown.index("rig")
    assert "→ make room" in shown
    assert "&lt;17&gt;" in shown
    assert "not used" in shown


@pytest.mark.parametrize("language", LANGUAGES.values())
@pytest.mark.parametrize("name", ["human_17", "human_23"])
def test_whatever_a_body_can_do_has_a_name_in_every_language(language, name):
    body = load_body(name)
    named = texts(language)
    assert {f"segment_{each}" for each in body.segment_names} <= named.keys()
    assert {f"segment_{joint.name}" for joint in body.joints} <= named.keys()
    assert {f"angle_{angle.name}" for joint in body.joints for angle in joint.angles} <= named.keys()
    assert {f"name_{step}" for step in timetable()} <= named.keys()
    assert len({movement_name(language, key[6:]) for key in named if key.startswith("angle_")}) == 14


def test_a_recording_s_clock_goes_on_between_messages():
    status = RecordingStatus()
    status.take({"state": "recording", "seconds": 2.0}, 5_000_000_000)
    status.take({"state": "off"}, 4_000_000_000)  # older
    assert status.now(7_000_000_000)["seconds"] == 4.0
    status.take({"state": "off", "seconds": 4.2}, 8_000_000_000)
    assert status.now(9_000_000_000)["seconds"] == 4.2


@pytest.mark.parametrize(
    ("error", "said"), [(GatewayError("no suit"), "no suit"), (KeyError("x"), "report it")]
)
async def test_what_goes_wrong_is_told_whatever_it_is(error, said):
    told = asyncio.Queue()

    async def action():
        raise error

    Errands().start(action, told.put_nowait)
    assert said in await told.get()


def test_there_is_a_picture_of_every_step_and_movement():
    steps = [*timetable(), *(f"move_{movement.name}" for movement in MOVEMENTS)]
    for step in steps:
        picture = step_picture(step, "<what to do>")
        assert picture.count("<line") > 30
        assert 'aria-label="&lt;what to do&gt;"' in picture
    assert step_picture("unknown", "") == ""


@pytest.mark.parametrize("language", LANGUAGES.values())
def test_whatever_was_found_of_a_sensor_is_told(language):
    """``none``: too little was heard to find anything."""
    for quality in ("good", "fair", "poor", "none"):
        table = sensor_table({"5": {"gyroscope": {"quality": quality, "reasons": ["no rest"]}}}, language)
        assert translated(language, quality) in table
        assert "no rest" in table
