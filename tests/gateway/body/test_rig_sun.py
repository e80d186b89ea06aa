"""Photoelectric cells and pressure tubes in rig files, there and back."""

import numpy as np
import pytest
import yaml

from gateway.body.rig import load_rig
from gateway.errors import SettingsError
from gateway.frames import Quantity
from gateway.recording.snapshot import decode_suit, encode_suit, rig_of
from gateway.support.settings_files import find_file

SLANTED = [[1, 0, 0.2], [-1, 0, 0.2], [0, 1, 0.2], [0, -1, 0.2], [0, 0, 1], [0, 0, -1]]


def rig(tmp_path, **changes):
    content = yaml.safe_load(find_file("robot_arm_4_sun", "rigs").read_text(encoding="utf-8"))
    content["modules"][1]["cells"] = SLANTED
    content["world"]["second_field"] = "both"
    tubes = {"kind": "air_velocity", "device": 61, "segment": "link_2", "device_to_segment": [0, 0, 1, 0]}
    content["local_devices"].append(tubes)
    for path, value in changes.items():
        at = content
        *way, last = path.split("__")
        for step in way:
            at = at[int(step) if step.isdigit() else step]
        at[last] = value
    file = tmp_path / "rig.yaml"
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    return str(file)


def test_cells_place_and_tubes_are_read(tmp_path):
    suit = load_rig(rig(tmp_path))
    assert suit.sun.beside_magnetometer
    assert (suit.sun.latitude_deg, suit.sun.longitude_deg) == (47.4, 8.5)
    assert suit.sun.normals.shape == (4, 6, 3)
    assert np.array_equal(suit.sun.normals[1], SLANTED)
    assert np.array_equal(suit.sun.normals[0, :2], [[1, 0, 0], [-1, 0, 0]])
    tubes = suit.local_devices[1]
    assert (tubes.quantity, tubes.device) == (Quantity.AIR_VELOCITY, 61)
    assert np.array_equal(tubes.orientation, [0, 0, 1, 0])


def test_a_rig_without_a_place_has_no_sun():
    assert load_rig("robot_arm_4").sun is None


def test_a_recorded_suit_has_the_same_cells_bit_for_bit(tmp_path):
    suit = load_rig(rig(tmp_path))
    again = decode_suit(encode_suit(suit))
    assert np.array_equal(again.sun.normals, suit.sun.normals)
    assert again.sun.latitude_deg == suit.sun.latitude_deg
    assert again.sun.beside_magnetometer is True
    assert decode_suit(encode_suit(load_rig("robot_arm_4"))).sun is None


def test_the_rig_file_written_of_a_suit_says_the_same(tmp_path):
    suit = load_rig(rig(tmp_path))
    content = rig_of(suit)
    content["body"] = "robot_arm_4"
    file = tmp_path / "again.yaml"
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    again = load_rig(str(file))
    assert np.array_equal(again.sun.normals, suit.sun.normals)
    assert again.sun.beside_magnetometer
    assert np.array_equal(again.local_devices[1].orientation, suit.local_devices[1].orientation)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"world__place": None}, "needs 'place"),
        ({"world__second_field": "magnetometer"}, "no other does"),
        ({"world__second_field": "moon"}, "world.second_field"),
        ({"world__place__latitude_deg": 97}, "world.place.latitude_deg"),
        ({"modules__0__cells": [[1, 0, 0]] * 6}, "span space"),
        ({"modules__0__cells": [[1, 0, 0]]}, "modules.0.cells"),
        ({"local_devices__1__device_to_segment": [1, 1, 0, 0]}, "length 1.414"),
    ],
)
def test_mistakes_are_named(tmp_path, changes, told):
    with pytest.raises(SettingsError, match=told):
        load_rig(rig(tmp_path, **changes))
