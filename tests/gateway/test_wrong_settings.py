"""Every setting of every file that people write, wrong in turn: one line that names file and setting."""

from __future__ import annotations

import copy
import datetime
import itertools
import math
import traceback
import types
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from devices.emulators.faults.fault_plan import FaultPlan
from devices.link import LinkError
from devices.vendor_formats.column_map import ColumnMap
from gateway.analysis.inertia_file import InertiaFile
from gateway.analysis.muscle_settings import MuscleFile
from gateway.body.body_file import load_body
from gateway.body.rig import load_rig
from gateway.body.robot import RobotFile
from gateway.calibration.cameras_file import load_cameras
from gateway.cameras.broker_link import link_of
from gateway.clocks.table import ClockTableFile
from gateway.errors import GatewayError
from gateway.reconstruction.video.keypoint_set import KeypointSetFile
from gateway.settings import GatewaySettings, load_gateway_settings
from gateway.sources.registry import SOURCES
from gateway.support.settings_files import load_settings

WRONG = {
    "a word": "no such thing",
    "nothing": None,
    "an empty text": "",
    "a zero byte": "\0",
    "a very long text": "x" * 5000,
    "terminal markup": "[/red]",
    "below": -1,
    "huge": 10**12,
    "half": 0.5,
    "not a number": math.nan,
    "infinite": math.inf,
    "true": True,
    "a list": [],
    "a list of texts": ["a"],
    "a map": {},
    "a map of texts": {"a": "b"},
    "a date": datetime.date(2026, 1, 1),
}
LONGEST_ANSWER = 6000
Place = tuple[str | int, ...]


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the settings classes inside an annotation."""
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        if issubclass(annotation, BaseModel):
            yield annotation
        return
    for inner in typing.get_args(annotation):
        yield from models_in(inner)


def fields_of(model: type[BaseModel]) -> Iterator[Place]:
    """Yield the places of all settings, those that have defaults too; of lists the first entry."""
    for name, field in model.model_fields.items():
        yield (name,)
        parts = (field.annotation, *typing.get_args(field.annotation))
        origins = {typing.get_origin(part) for part in parts}
        if dict in origins:
            continue
        is_list = bool(origins & {list, tuple})
        for inner in models_in(field.annotation):
            for place in fields_of(inner):
                yield (name, 0, *place) if is_list else (name, *place)


def places_in(content: Any) -> Iterator[Place]:
    """Yield the places of all that stands in a file; of lists the first entry."""
    entries = content.items() if isinstance(content, dict) else enumerate(content[:1])
    for key, value in entries:
        yield (key,)
        if isinstance(value, dict | list):
            for place in places_in(value):
                yield (key, *place)


def with_value(content: Any, place: Place, value: Any) -> Any:
    """Return a copy with another value at a place, which is made where it is not there."""
    changed = copy.deepcopy(content)
    at = changed
    for key, following in itertools.pairwise(place):
        empty: Any = [] if isinstance(following, int) else {}
        if isinstance(at, list):
            at.extend([{}] * (int(key) + 1 - len(at)))
        elif not isinstance(at.get(key), dict | list):
            at[key] = empty
        at = at[key]
    if isinstance(at, list) and len(at) <= int(place[-1]):
        at.append(value)
    else:
        at[place[-1]] = value
    return changed


def faults_of(path: Path, base: Any, places: Iterator[Place], load: Callable[[Path], object]) -> list[str]:
    """Set each of ``places`` wrong in turn; return what was not answered as it should be."""
    path.write_text(yaml.safe_dump(base))
    load(path)
    found = []
    for place in dict.fromkeys(places):
        names = [part for part in place if isinstance(part, str)]
        for kind, value in WRONG.items():
            path.write_text(yaml.safe_dump(with_value(base, place, value), allow_unicode=True))
            what = f"{'.'.join(map(str, place))} = {kind}"
            try:
                load(path)
            except (GatewayError, LinkError) as error:
                told = str(error)
                if ".yaml" not in told and "link '" not in told:
                    found.append(f"{what}: names no file: {told[:200]}")
                is_told = any(text in told for text in (*names[-2:], f"'{value}'", f" {value}", "is missing"))
                if not is_told:
                    found.append(f"{what}: names neither setting nor value: {told[:200]}")
                if len(told) > LONGEST_ANSWER:
                    found.append(f"{what}: {len(told)} characters")
            except Exception as error:
                where = traceback.extract_tb(error.__traceback__)[-1]
                found.append(f"{what}: {error!r} in {Path(where.filename).name}:{where.lineno}")
    return found


GATEWAY = {
    "rig": "single",
    "reconstructor": "independent",
    "links": [{"name": "suit", "url": "tcp://127.0.0.1:7000"}],
}


def checked(path: Path) -> None:
    """Do what ``config check`` does, but for whether the rig has a use for what links carry."""
    settings = load_gateway_settings(path)
    load_rig(settings.rig, path)
    for link in settings.links:
        link_of(link, settings.mqtt, lambda: settings.mqtt.port)


def test_a_configuration(tmp_path):
    places = (place for place in fields_of(GatewaySettings) if place[0] != "links" or len(place) == 1)
    faults = faults_of(tmp_path / "gateway.yaml", GATEWAY, places, checked)
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize("carries", SOURCES)
def test_a_link(carries, tmp_path):
    link = {"name": "suit", "url": "tcp://127.0.0.1:7000", "carries": carries}
    kind = SOURCES[carries].settings
    if "module" in kind.model_fields:
        link["module"] = 1
    places = (("links", 0, *place) for place in fields_of(kind))
    faults = faults_of(tmp_path / "gateway.yaml", GATEWAY | {"links": [link]}, places, checked)
    assert not faults, "\n".join(faults)


MODULE = {
    "id": 1,
    "segment": "thorax",
    "position": [0, 0, 0.1],
    "sensor_to_segment": [1, 0, 0, 0],
    "ranges": {"accelerometer": 160, "gyroscope": 2000},
}
WRITTEN = {
    "rig": (
        {
            "body": "arm_3",
            "modules": [MODULE],
            "local_devices": [{"kind": "position", "segment": "thorax", "device": 60, "position": [0, 0, 0]}],
            "world": {
                "gravity": 9.81,
                "magnetic_field": {"norm_ut": 49, "dip_deg": 66, "declination_deg": 3},
                "second_field": "both",
                "place": {"latitude_deg": 48, "longitude_deg": 11},
            },
            "subject": {"height_m": 1.7, "mass_kg": 60, "sex": "female", "lengths": {"upper_arm": 0.3}},
            "joint_definitions": {},
        },
        lambda path: load_rig(str(path)),
    ),
    "body": (
        {
            "name": "two",
            "stature_m": 1.75,
            "neutral": [1, 0, 0, 0],
            "segments": [
                {"name": "upper", "parent": None, "tip": [0, -0.3, 0], "contacts": [[0, 0, 0]]},
                {"name": "lower", "parent": "upper", "joint": [0, -0.3, 0], "tip": [0, -0.25, 0]},
            ],
            "joints": [
                {
                    "name": "elbow",
                    "proximal": "upper",
                    "distal": "lower",
                    "source": "nobody",
                    "angles": {"flexion": {"axis": "z", "limits_deg": [-10, 155]}},
                    "free": ["flexion"],
                }
            ],
        },
        lambda path: load_body(str(path)),
    ),
    "robot": (
        {
            "urdf": "model.urdf",
            "base": "pelvis",
            "forward": "x",
            "soles": ["foot"],
            "neutral_deg": {"knee": 3},
            "most_deg_per_s": 100,
            "links": {"tool0": {"segment": "right_hand", "orientation": 0.3}},
        },
        lambda path: load_settings(path, RobotFile),
    ),
    "keypoints": (
        {"name": "two", "body": "human_17", "keypoints": {"nose": {"segment": "head", "at": [0.1, 0.1, 0]}}},
        lambda path: load_settings(path, KeypointSetFile),
    ),
    "columns": (
        {
            "time": {"column": "t", "unit": "s"},
            "modules": [
                {
                    "name": "pelvis",
                    "file": "a.csv",
                    "specific_force": {"columns": ["ax", "ay", "az"], "unit": "g"},
                    "angular_rate": {"columns": ["gx", "gy", "gz"], "unit": "deg/s"},
                    "magnetic_field": {"columns": ["mx", "my", "mz"]},
                    "orientation": {"columns": ["w", "x", "y", "z"], "order": "wxyz", "world": "enu"},
                }
            ],
        },
        lambda path: load_settings(path, ColumnMap),
    ),
    "clock table": (
        {"reference": 0, "interval_s": 60, "ranking": [0, 1], "alpha": {0: [1.0], 1: [1.0]}},
        lambda path: load_settings(path, ClockTableFile),
    ),
    "inertia": (
        {"segments": {"link_1": {"mass_kg": 1, "centre_m": [0, 0, 0], "inertia_kg_m2": [1, 1, 1]}}},
        lambda path: load_settings(path, InertiaFile),
    ),
    "muscles": (
        {
            "strength": 0.8,
            "curves": "length",
            "muscles": [{"name": "vas*_l", "weight": 2, "bias": 0.05, "strength": 1}],
            "guide": {"file": "emg.csv", "weight": 20},
        },
        lambda path: load_settings(path, MuscleFile),
    ),
    "faults": (
        {"seed": 1, "faults": [{"kind": "loss", "at": 12, "lasts": 3, "share": 0.3, "every": 60}]},
        lambda path: load_settings(path, FaultPlan),
    ),
    "cameras": (
        {
            "up": "z",
            "cameras": [
                {
                    "name": "a",
                    "size": [640, 480],
                    "matrix": [[800, 0, 320], [0, 800, 240], [0, 0, 1]],
                    "distortion": [0, 0, 0, 0, 0],
                    "rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
                    "translation": [0, 1, 3],
                    "reprojection_px": 0.3,
                }
            ],
        },
        load_cameras,
    ),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_file_of_ones_own(name, tmp_path):
    base, load = WRITTEN[name]
    faults = faults_of(tmp_path / "mine.yaml", base, places_in(base), load)
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize("written", ["true", "yes", "false"])
@pytest.mark.parametrize("setting", ["mqtt: {port: %s}", "assembly: {rate_hz: %s}", "metrics: {port: %s}"])
def test_a_truth_value_is_no_number(setting, written, tmp_path):
    path = tmp_path / "gateway.yaml"
    path.write_text("rig: single\nlinks: [{name: suit, url: tcp://127.0.0.1:7000}]\n" + setting % written)
    with pytest.raises(GatewayError, match=r"gateway\.yaml: '(mqtt|assembly|metrics)"):
        load_gateway_settings(path)


@pytest.mark.parametrize("setting", ["gateway: a/b", "recording: {name: ../a}"])
def test_a_name_that_is_none_is_refused_in_words(setting, tmp_path):
    path = tmp_path / "gateway.yaml"
    path.write_text("rig: single\nlinks: [{name: suit, url: tcp://127.0.0.1:7000}]\n" + setting)
    with pytest.raises(GatewayError, match="letters a to z, digits") as refused:
        load_gateway_settings(path)
    assert "pattern" not in str(refused.value)


def test_a_truth_value_in_a_list_is_no_number(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text("body: single\nmodules:\n  - {id: true, segment: body, position: [yes, 0, 0]}\n")
    with pytest.raises(GatewayError, match=r"modules\.0\.id.*\n.*modules\.0\.position\.0"):
        load_rig(str(path))


@pytest.mark.parametrize(
    ("host", "told"),
    [
        ("mqtt://me:hunter2@lab", "leave out what stands before the @"),
        ("me:hunter2@lab", "leave out what stands before the @"),
        ("mqtt://lab", "alone is wanted"),
        ("lab:1883", "without port"),
        ("lab hall", "alone is wanted"),
    ],
)
def test_a_broker_is_a_host_alone_and_secrets_are_not_repeated(host, told, tmp_path):
    path = tmp_path / "gateway.yaml"
    path.write_text(yaml.safe_dump({**GATEWAY, "mqtt": {"host": host}}))
    with pytest.raises(GatewayError, match=rf"'mqtt\.host'.*{told}") as caught:
        load_gateway_settings(path)
    assert "hunter2" not in str(caught.value)


@pytest.mark.parametrize("host", ["lab", "lab.example", "my_broker", "127.0.0.1", "::1"])
def test_a_broker_may_be_a_name_or_an_address(host, tmp_path):
    path = tmp_path / "gateway.yaml"
    path.write_text(yaml.safe_dump({**GATEWAY, "mqtt": {"host": host}}))
    assert load_gateway_settings(path).mqtt.host == host


@pytest.mark.parametrize(
    ("setting", "wanted"),
    [
        (
            {"assembly": {"rate_hz": "100 Hz"}},
            "'assembly.rate_hz' is '100 Hz': a number is wanted, without its",
        ),
        ({"mqtt": {"port": "1883/tcp"}}, "'mqtt.port' is '1883/tcp': a whole number is wanted"),
        ({"mqtt": {"include": "position"}}, "'mqtt.include' is 'position': a list is wanted"),
        ({"links": "/dev/ttyUSB0"}, "'links' is '/dev/ttyUSB0': a list is wanted"),
        ({"links": []}, "'links' is \\[\\]: it has too few entries"),
        ({"rig": None}, "'rig' is None: a text is wanted"),
        ({"log": "info"}, "'log' is 'info': a section of 'key: value' lines is wanted"),
        ({"allow_device_writes": "maybe"}, "true or false is wanted"),
    ],
)
def test_a_value_of_another_kind_is_refused_in_words_that_say_what_is_wanted(setting, wanted, tmp_path):
    """Not in those of Python's types: "a valid frozenset"."""
    path = tmp_path / "gateway.yaml"
    path.write_text(yaml.safe_dump({**GATEWAY, **setting}))
    with pytest.raises(GatewayError, match=wanted):
        load_gateway_settings(path)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("/dev/ttyUSB0", "serial:///dev/ttyUSB0?baud=115200"),
        ("udp://0.0.0.0:7000", "udp://0.0.0.0:7000?peers=10.0.0.1"),
        ("slcan:///dev/ttyACM0", "slcan:///dev/ttyACM0"),
    ],
)
def test_two_links_on_one_port_are_refused(first, second, tmp_path):
    """The second one would wait for ever for what the first one has."""
    path = tmp_path / "gateway.yaml"
    links = [{"name": "left", "url": first}, {"name": "right", "url": second}]
    path.write_text(yaml.safe_dump({**GATEWAY, "links": links}))
    with pytest.raises(GatewayError, match="'left' and 'right' name the same port"):
        load_gateway_settings(path)


@pytest.mark.parametrize("name", ["rotate_mb", "rotate_minutes"])
def test_files_of_a_recording_that_hold_next_to_nothing_are_refused(name, tmp_path):
    """Each look at the size began another one."""
    path = tmp_path / "gateway.yaml"
    plain = "rig: suit_17\nlinks: [{name: a, url: /dev/ttyACM0}]\n"
    for most in (0, 1):
        path.write_text(f"{plain}recording: {{{name}: {most}}}\n")
        load_gateway_settings(path)
    path.write_text(f"{plain}recording: {{{name}: 0.0001}}\n")
    with pytest.raises(GatewayError, match=f"'recording.{name}' is 0.0001: at least 1 is wanted, or 0"):
        load_gateway_settings(path)


@pytest.mark.parametrize("url", ["can://socketcan/can0", "/data/walk.mcap?link=a", "udp://:0"])
def test_a_bus_a_recording_and_any_free_port_may_have_several_links(url, tmp_path):
    path = tmp_path / "gateway.yaml"
    links = [{"name": "left", "url": url}, {"name": "right", "url": url}]
    path.write_text(yaml.safe_dump({**GATEWAY, "links": links}))
    assert len(load_gateway_settings(path).links) == 2
