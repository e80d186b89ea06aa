"""Seven real x-IMU3 on somebody who walks, as they would have come over UDP: real stamps, real losses."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from devices.link import Chunk
from devices.vendor_protocols.ximu3 import encode_binary, encode_command
from gateway.body.rig import load_rig
from gateway.contract.balances import unaccounted
from gateway.pipeline import Pipeline
from gateway.service.accounting import balances_of
from gateway.settings import GatewaySettings

LOST = {
    "Pelvis": 28,
    "Right Upper Leg": 27,
    "Right Lower Leg": 11,
    "Right Foot": 23,
    "Left Upper Leg": 8,
    "Left Lower Leg": 21,
    "Left Foot": 8,
}
"""Inertial messages that never came, by the counts of the set's README."""
SEGMENTS = {"Pelvis": "pelvis", "Upper Leg": "thigh", "Lower Leg": "shank", "Foot": "foot"}
FILES = {"Inertial": b"I", "Magnetometer": b"M", "Battery": b"B", "Rssi": b"W", "Temperature": b"T"}
BEGUN_NS = 1_800_000_000_000_000_000
DELAY_US = 1500.0


def module_of(name, suit):
    """The rig's module on the segment that a device is named for, as ``Left Upper Leg``."""
    first, _, part = name.partition(" ")
    segment = f"{first.lower()}_{SEGMENTS[part]}" if part else SEGMENTS[first]
    return suit.module_ids[suit.module_of_segment[suit.skeleton.segment_names.index(segment)]]


def messages(folder):
    """(stamp in µs, bytes), in order of stamps."""
    told = json.loads((folder / "Command.json").read_text())[0]["ping"]
    found = []
    for name, letter in FILES.items():
        with (folder / f"{name}.csv").open(newline="") as opened:
            rows = csv.reader(opened)
            next(rows)
            for stamp, *values in rows:
                found.append((int(stamp), encode_binary(letter, int(stamp), list(map(float, values)))))
    found.sort(key=lambda each: each[0])
    return told, [(found[50][0], encode_command("ping", told)), *found]


@pytest.fixture(scope="module")
def walked(recording_set):
    suit = load_rig("suit_lower_7")
    links, spoken = [], []
    rng = np.random.default_rng(1)
    for folder in sorted(recording_set("xio_lower_body7").iterdir()):
        if not (folder / "Inertial.csv").is_file():
            continue
        told, said = messages(folder)
        name = told["name"]
        module = module_of(name, suit)
        links.append({"name": name, "url": "udp://:1", "carries": "ximu3", "module": module})
        for stamp_us, data in said:
            arrived_ns = BEGUN_NS + round((stamp_us + DELAY_US + rng.exponential(800.0)) * 1000)
            spoken.append(Chunk(data, arrived_ns, name, "192.168.1.2:9000"))
    settings = GatewaySettings(links=links, rig="suit_lower_7", assembly={"rate_hz": 50})
    pipeline = Pipeline.from_settings(settings, suit)
    for link in links:
        pipeline.add_link(link["name"], "ximu3")
    spoken.sort(key=lambda chunk: chunk.arrived_ns)
    poses = [pose for chunk in spoken for pose in pipeline.feed(chunk)]
    return pipeline, {link["name"]: link["module"] for link in links}, poses


def test_every_message_is_read_and_what_never_came_is_counted(walked):
    pipeline, modules, _ = walked
    assert not any(counts for counts in pipeline.dropped().values())
    for name, lost in LOST.items():
        record = pipeline.modules.records[modules[name]]
        inertial = record.sequences[next(kind for kind in record.sequences if kind < 256)]
        # one that is missing among the first few, before their interval is known, is not noticed
        assert lost - 1 <= inertial.lost <= lost, name
    assert unaccounted(balances_of(pipeline, {}, None, {})) == {}


def test_they_tell_who_and_how_they_are(walked):
    pipeline, modules, _ = walked
    for name, module in modules.items():
        record = pipeline.modules.records[module]
        assert record.health.battery_percent > 50, name
        assert -90 < record.health.rssi_dbm < -20, name
        assert record.info.unique_id.hex().startswith("64f"), name
        assert record.clock.restarts == 0, name


def test_the_legs_move(walked):
    _, _, poses = walked
    assert len(poses) > 0.95 * 18 * 50
    turned = np.array([pose.q_wb for pose in poses[100:]])
    assert np.isfinite(turned).all()
    assert (np.ptp(turned, axis=0).max(axis=-1) > 0.1).all()  # every segment
