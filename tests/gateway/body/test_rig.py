"""Bodies and rigs: the shipped ones load, wrong ones are refused with the place and the remedy."""

import re

import numpy as np
import pytest

from gateway.body.body_file import load_body
from gateway.body.rig import load_rig
from gateway.body.skeleton import field_vector
from gateway.errors import SettingsError
from gateway.frames import Quantity
from gateway.support.settings_files import shipped_folder

RIG = """
body: robot_arm_4
modules:
  - {{id: 0, segment: link_1}}
  - {{id: 1, segment: {segment}{extra}}}
{more}
"""


def write(tmp_path, segment="link_2", extra="", more=""):
    path = tmp_path / "rig.yaml"
    path.write_text(RIG.format(segment=segment, extra=extra, more=more))
    return path


UNMEASURED = {
    "wifi_10": {"head", "girdle", "hand", "foot"},
    "slimevr_8": {"head", "girdle", "arm", "forearm", "hand"},
}
"""Segments, by their last word, that a rig of few modules leaves bare, as its first lines say."""


@pytest.mark.parametrize("path", sorted((shipped_folder() / "rigs").glob("*.yaml")), ids=lambda p: p.stem)
def test_shipped_rigs_load_and_dress_every_segment_or_say_what_it_follows(path):
    suit = load_rig(path.stem)
    ruled = {rule.segment for rule in suit.skeleton.interpolations}
    bare = set(np.flatnonzero(suit.module_of_segment < 0).tolist()) - ruled
    assert {suit.skeleton.segment_names[s].split("_")[-1] for s in bare} <= UNMEASURED.get(
        path.stem, {"toes"}
    )
    assert len(suit.module_ids) == np.count_nonzero(suit.module_of_segment >= 0)
    np.testing.assert_allclose(np.linalg.norm(suit.sensor_to_segment, axis=1), 1)


def test_the_suit_has_17_modules_on_a_person_of_right_height():
    suit = load_rig("suit_17")
    assert len(suit.module_ids) == 17
    body = suit.skeleton
    up = dict.fromkeys(body.segment_names, 0.0)
    for i, name in enumerate(body.segment_names[1:], start=1):
        up[name] = up[body.segment_names[body.parents[i]]] + body.offsets[i, 1]
    crown = up["head"] + body.tips[body.index("head"), 1]
    sole = up["left_foot"] + body.tips[body.index("left_foot"), 1]
    assert crown - sole == pytest.approx(1.75, abs=0.05)
    assert suit.local_devices[0].quantity is Quantity.ACCELERATION


def test_a_rig_may_lie_anywhere_and_name_a_body_beside_it(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "name: mine\nsegments:\n  - {name: a, parent: null, tip: [1, 0, 0]}\n"
        "  - {name: b, parent: a, joint: [1, 0, 0], tip: [1, 0, 0]}\n"
    )
    rig = tmp_path / "rig.yaml"
    rig.write_text("body: mine.yaml\nmodules:\n  - {id: 5, segment: b, position: [0.1, 0, 0]}\n")
    suit = load_rig(str(rig))
    assert suit.module_ids == (5,)
    assert suit.module_of_segment.tolist() == [-1, 0]
    np.testing.assert_allclose(suit.lever_arms[1], [0.1, 0, 0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"segment": "link_22"}, r"rig\.yaml: module 1 sits on 'link_22'.*did you mean 'link_2'"),
        ({"segment": "link_1"}, "'link_1' carries modules 0 and 1"),
        (
            {"extra": ", positon: [0, 0, 0]"},
            r"unknown setting 'modules\.1\.positon' \(did you mean 'position'",
        ),
        ({"extra": ", sensor_to_segment: [1, 1, 0, 0]"}, "length 1 is wanted, this one has length 1.414"),
        ({"extra": ", position: [0, .nan, 0]"}, r"modules\.1\.position\.1.*finite"),
        ({"extra": ", position: [30, 0, 120]"}, r"modules\.1\.position\.0' is 30: at most 20 is wanted"),
        ({"more": "world: {gravity: 98}"}, r"'world\.gravity' is 98.*less than 10"),
        (
            {"more": "local_devices: [{kind: position, segment: link_1}]"},
            "kind 'position' needs its 'device' id",
        ),
        (
            {"more": "local_devices: [{kind: position, segment: link_1, device: 1}]"},
            "id 1 is given to a module and to a local device",
        ),
    ],
)
def test_wrong_rigs_are_refused_with_place_and_remedy(tmp_path, change, message):
    with pytest.raises(SettingsError, match=message):
        load_rig(str(write(tmp_path, **change)))


def test_a_module_id_given_twice_is_named(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(
        "body: robot_arm_4\nmodules:\n  - {id: 3, segment: link_1}\n  - {id: 3, segment: link_2}\n"
    )
    with pytest.raises(SettingsError, match="module id 3 is given to 'link_1' and 'link_2'"):
        load_rig(str(path))


def test_an_unknown_rig_names_the_nearest_shipped_one():
    with pytest.raises(SettingsError, match="did you mean 'suit_17'"):
        load_rig("suit17")


def test_parents_stand_before_children(tmp_path):
    path = tmp_path / "body.yaml"
    path.write_text(
        "name: x\nsegments:\n  - {name: a, parent: null, tip: [1, 0, 0]}\n"
        "  - {name: b, parent: c, tip: [1, 0, 0]}\n  - {name: c, parent: a, tip: [1, 0, 0]}\n"
    )
    with pytest.raises(SettingsError, match="parent 'c' of 'b' must be a segment standing before it"):
        load_body(str(path))


def test_broken_yaml_names_file_and_line(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text("body: robot_arm_4\nmodules: [\n")
    with pytest.raises(SettingsError, match=re.escape(str(path)) + ".*line 3"):
        load_rig(str(path))


def test_field_vector_points_north_and_down():
    np.testing.assert_allclose(field_vector(50, 0, 0), [0, 50, 0], atol=1e-12)
    np.testing.assert_allclose(field_vector(50, 90, 0), [0, 0, -50], atol=1e-12)
    np.testing.assert_allclose(field_vector(50, 0, 90), [50, 0, 0], atol=1e-12)
