"""Programs that take what other outputs send, run as docs/guide/outputs.md and the examples' guide say."""

from __future__ import annotations

import asyncio
import ctypes.util
import importlib.util
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from gateway.body.kinematics import joint_positions
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.frames import SkeletonFrame
from gateway.outputs.settings import OutputsSettings
from gateway.outputs.side_outputs import SideOutputs
from gateway.recording import SkeletonArrays
from gateway.recording.exporters.formats import FORMATS, Axes
from gateway.recording.exporters.take import take_of
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system
ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
SUIT = load_rig("suit_17")
BODY = SUIT.skeleton
WALK = move(dress(SUIT), BODY.name, 3)


def pose(k: int) -> SkeletonFrame:
    """A walking person, 10 ms a pose."""
    n = BODY.n_segments
    q_wb = np.ascontiguousarray(WALK.state(np.array([2.0 + 0.01 * k])).q_wb[0])
    p_w = joint_positions(BODY.parents, BODY.offsets, q_wb, np.array([0.0, 0.0, 0.95]))
    zeros = np.zeros((n, 3))
    return SkeletonFrame(k, 10**9 + 10**7 * k, q_wb, zeros, zeros, p_w, np.zeros(n), np.zeros(n, np.uint8), 0)


async def lines_of(settings: dict, *typed: object, count: int, environment: dict | None = None) -> list[str]:
    """The first lines that a program prints while poses are offered; then it is ended."""
    side = SideOutputs(OutputsSettings.model_validate(settings), BODY, "lab", 100.0, publish=lambda *_: True)
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        *map(str, typed), stdout=pipe, stderr=pipe, env={**os.environ, **(environment or {})}
    )
    assert process.stdout is not None
    lines: list[str] = []

    async def read() -> None:
        while len(lines) < count:
            line = await process.stdout.readline()
            if not line:
                raise AssertionError((await process.stderr.read()).decode())
            lines.append(line.decode().strip())

    try:
        async with asyncio.timeout(2 * PATIENCE_S), side.running():
            reading, k = asyncio.create_task(read()), 0
            while not reading.done():
                side.offer(pose(k))
                k += 1
                await asyncio.sleep(0.01)
            await reading
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()
    return lines


async def test_the_lines_about_udp_json_print_poses(unused_port, tmp_path):
    (program,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "guide" / "outputs.md").read_text(), re.DOTALL
    )
    assert len(program.splitlines()) <= 10
    (tmp_path / "receive.py").write_text(program.replace("39600", str(unused_port)))
    typed = [sys.executable, "-u", tmp_path / "receive.py"]
    lines = await lines_of({"udp_json": {"port": unused_port}}, *typed, count=3)
    assert re.fullmatch(r"\d+ \[[-\d., e]+\]", lines[0])


@pytest.fixture
def icub() -> Path:
    pytest.importorskip("mink", reason="the extra robot is not installed")
    models = pytest.importorskip("icub_models", reason="icub-models is not installed")
    return Path(models.get_model_file("iCubGazeboV2_7"))


async def test_a_robots_program_gets_joint_angles(icub, unused_port):
    settings = {"retarget": {"robot": "icub", "urdf": icub, "mqtt": False, "udp": {"port": unused_port}}}
    typed = [sys.executable, EXAMPLES / "robot" / "follow.py", unused_port]
    lines = await lines_of(settings, *typed, count=3)
    assert re.match(r"\d+ .*\bl_elbow 0\.\d{3}", lines[0])


async def test_a_robot_in_mujoco_follows(icub, unused_port, tmp_path):
    """Its joints, which have mass, against what they were to be; filmed, where the computer can draw."""
    draws = ctypes.util.find_library("OSMesa") and importlib.util.find_spec("PIL")
    film = ["--film", tmp_path / "robot.gif"] if draws else []
    settings = {"retarget": {"robot": "icub", "urdf": icub, "mqtt": False, "udp": {"port": unused_port}}}
    typed = [sys.executable, EXAMPLES / "robot" / "simulate.py", icub, "--port", unused_port, *film]
    environment = {"MUJOCO_GL": "osmesa" if draws else "disable"}
    lines = await lines_of(settings, *typed, "--seconds", 2, count=2, environment=environment)
    found = re.fullmatch(r"(\d+) poses; joints off by ([\d.]+)°, 95 % by less than ([\d.]+)°", lines[1])
    assert found is not None, lines
    assert float(found[2]) < 2.0
    assert float(found[3]) < 6.0
    if film:
        from PIL import Image  # noqa: PLC0415 - comes with matplotlib

        with Image.open(tmp_path / "robot.gif") as pictures:
            assert pictures.n_frames > 10


async def test_ros_2_is_heard_without_ros(unused_port):
    pytest.importorskip("zenoh", reason="the extra ros2 is not installed")
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    typed = [sys.executable, EXAMPLES / "ros2" / "listen.py", unused_port]
    lines = await lines_of({"ros2": {"router": f"tcp/127.0.0.1:{unused_port}"}}, *typed, count=20)
    assert {line.split()[1] for line in lines} >= set(BODY.segment_names)
    assert re.fullmatch(r"\d+\.\d{2}0{7} \w+( -?\d\.\d{3}){4}", lines[0])


def two_poses() -> SkeletonArrays:
    poses = [pose(0), pose(1)]
    names = ("q_wb", "p_w", "angular_rate", "joint_acceleration", "sigma", "status")
    arrays = [np.array([getattr(one, name) for one in poses]) for name in names]
    return SkeletonArrays(np.array([one.time_ns for one in poses]), np.arange(2), *arrays, BODY)


async def test_an_opensim_model_moves_along(unused_port, tmp_path):
    python = os.environ.get("MOCAP_OPENSIM")
    if python is None:
        pytest.skip("no OpenSim: MOCAP_OPENSIM names a Python that has it (pip install opensim)")
    model = tmp_path / "person.osim"
    FORMATS["osim"].write(take_of(two_poses(), "person", Axes.Y_UP), model, 1.0)
    live = (EXAMPLES / "opensim" / "live.py").read_text().replace("39800", str(unused_port))
    (tmp_path / "live.py").write_text(live)
    typed = [python, tmp_path / "live.py", model]
    lines = await lines_of({"opensim": {"port": unused_port, "model": model}}, *typed, count=3)
    assert re.match(r"\d+ \[", lines[-1])
