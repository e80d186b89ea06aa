"""Commands where an extra is not installed: all tell about themselves, and what needs it names it."""

import json
import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.system

WITHOUT_EXTRAS = """
import importlib.abc, importlib.util, json, sys
ABSENT = {"ai_edge_litert", "cv2", "distributed", "ezc3d", "matplotlib", "mujoco", "myo_sim", "osqp",
          "foxglove", "pyarrow", "pygltflib", "pylsl", "qtm_rt", "viser", "zenoh"}
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ABSENT:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in ABSENT else found(name, package)
sys.meta_path.insert(0, Absent())
from gateway.cli.lazy_commands import load
from gateway.cli.main import _Commands
from tests.typed_here import typed_here
"""
ALL_HELP = """
def tell(words, command):
    code, output, errors = typed_here([*words, "--help"])
    said[" ".join(words)] = "" if code == 0 and output else errors
    for name in getattr(command, "commands", {}):
        tell([*words, name], command.get_command(None, name))
said = {}
for name, lazy in _Commands.lazy.items():
    tell([name], load(name, lazy))
print(json.dumps(said))
"""


def without_extras(code):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS + code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_every_command_tells_about_itself():
    said = without_extras(ALL_HELP)
    assert {"view", "batch", "video solve", "video serve-camera", "calibrate cameras", "optical fit"} <= set(
        said
    )
    assert {name: errors for name, errors in said.items() if errors} == {}


def test_a_command_names_the_extra_that_it_lacks_and_how_to_add_it(tmp_path):
    (tmp_path / "cameras.yaml").touch()
    film = str(tmp_path / "a.mp4")
    typed = {
        "viewer": ["view", "--port", "1"],
        "biomech": ["analyse", film, "--mass", "70"],
        "plot": ["report", film],
        "export": ["export", film, "--to", "bvh", "--to", "gltf", "--output", str(tmp_path / "exported")],
        "video": ["video", "solve", film, "--cameras", str(tmp_path / "cameras.yaml")],
        "video ": ["video", "overlay", film, film],
        "video  ": ["video", "serve-camera", film, "--name", "left"],
    }
    code = f"print(json.dumps({{extra: typed_here(words) for extra, words in {typed!r}.items()}}))"
    for extra, (status, _, errors) in without_extras(code).items():
        assert status == 1
        assert len(errors.splitlines()) == 1, errors
        assert re.search(rf"pip install (-e )?'\S*\[{extra.strip()}\]'", errors), errors
    assert not (tmp_path / "exported").exists(), "one format was written before the other was found to lack"
