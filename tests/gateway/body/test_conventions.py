"""The table of docs/reference/conventions.md, row by row: which value grows with which movement."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from gateway.body.body_file import load_body
from gateway.body.joint_angles import JointAngles
from gateway.geometry import quaternion
from gateway.viewer.pose_table import attitude

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "conventions.md"
ROW = re.compile(r"\| ([\w ]+) \| `(\w+)` \| ([+-])([enu]) \| `(\w+)` `(\w+)` \| (\w+) (grows|falls) \|")
ROWS = ROW.findall(PAGE.read_text())
BODY = load_body("human_17")
AXES = {"e": (1.0, 0.0, 0.0), "n": (0.0, 1.0, 0.0), "u": (0.0, 0.0, 1.0)}
TURNED_DEG = 20.0


def test_the_table_is_read():
    assert len(ROWS) >= 15


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_movement(row):
    _, segment, sign, axis, joint, angle, part, way = row
    upright = np.tile(BODY.neutral, (BODY.n_segments, 1))
    turn = np.radians(float(f"{sign}{TURNED_DEG}")) * np.array(AXES[axis])
    turned = upright.copy()
    s = BODY.index(segment)
    turned[s] = quaternion.multiply(quaternion.from_rotation_vector(turn), upright[s])
    j = [each.name for each in BODY.joints].index(joint)
    k = [each.name for each in BODY.joints[j].angles].index(angle)
    before, after = (JointAngles(BODY).update(q_wb).angles[j, k] for q_wb in (upright, turned))
    assert np.degrees(after - before) == pytest.approx(TURNED_DEG, abs=0.1)
    names = {"heading": "heading_deg", "pitch": "pitch_deg", "roll": "roll_deg"}
    values = [getattr(attitude(tuple(q[s])), names[part]) for q in (upright, turned)]
    assert values[1] - values[0] == pytest.approx(TURNED_DEG if way == "grows" else -TURNED_DEG, abs=0.1)
