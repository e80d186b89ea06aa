"""What is fetched and run where the program is installed: pinned wheels, and nothing else."""

import os
import re
import subprocess
import tempfile
from importlib.metadata import requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent


def test_make_installs_wheels_only():
    show = "shown:; @echo $$PIP_ONLY_BINARY"
    told = subprocess.run(
        ["make", "-s", "--eval", show, "shown"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert told.stdout.strip() == ":all:"


def test_the_image_installs_hashed_wheels_only():
    lines = (ROOT / "docker" / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
    installing = [number for number, line in enumerate(lines) if "pip install" in line]
    assert lines.index("ENV PIP_ONLY_BINARY=:all:") < installing[0]
    for number in installing:
        for command in lines[number].split("pip install")[1:]:
            assert "--require-hashes" in command or "--no-deps" in command, lines[number]


def test_what_builds_the_program_is_pinned_with_all_that_it_needs():
    pinned = set(
        re.findall(r"(?m)^([\w.-]+)==\S+ \\\n    --hash=", (ROOT / "requirements/build.lock").read_text())
    )
    needed, waiting = set(), ["hatchling"]
    while waiting:
        name = waiting.pop()
        needed.add(name)
        for text in requires(name) or ():
            requirement = Requirement(text)
            if (requirement.marker is None or requirement.marker.evaluate({"extra": ""})) and (
                requirement.name not in needed
            ):
                waiting.append(requirement.name)
    assert needed == pinned


def hashes_of(lock: str) -> dict[str, int]:
    """Packages that are pinned, and how many hashes each has."""
    text = (ROOT / f"requirements/{lock}.lock").read_text()
    return {
        entry.partition("==")[0]: entry.count("--hash=sha256:")
        for entry in re.split(r"(?m)^(?=\w)", text)
        if entry
    }


@pytest.mark.parametrize("lock", ["runtime", "dev", "build", "source", "source_dev"])
def test_all_that_is_pinned_is_hashed_and_nothing_is_built_on_most_machines(lock: str) -> None:
    pinned = hashes_of(lock)
    assert pinned
    assert all(pinned.values())
    assert "cobs" not in pinned, "there is no wheel of it"


def test_where_vqf_has_no_wheel_it_is_built_by_what_is_pinned():
    """On arm64. Its own list of what builds it: setuptools, wheel, Cython, NumPy; ezc3d's has more."""
    assert set(hashes_of("source")) == {"cython", "numpy", "packaging", "setuptools", "wheel"}
    assert set(hashes_of("source_dev")) > {*hashes_of("source"), "cmake", "ninja", "scikit-build", "swig"}
    show = "shown:; @echo '$(FROM_SOURCE)' '$(BUILD_TOOLS)'"
    with tempfile.TemporaryDirectory() as folder:
        uname = Path(folder, "uname")
        uname.write_text("#!/bin/sh\necho aarch64\n")
        uname.chmod(0o755)
        told = subprocess.run(
            ["make", "-s", "--eval", show, "shown"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"PATH": f"{folder}:{os.environ['PATH']}"},
        )
    assert told.stdout.split() == [
        "--no-binary",
        "vqf,ezc3d",
        "--no-build-isolation",
        "requirements/source.lock",
    ]


def test_the_readme_names_what_must_be_installed_before_the_first_command():
    readme = (ROOT / "README.md").read_text()
    assert readme.index("apt install make git python3-venv") < readme.index("make demo")
