"""What is fetched and run where the program is installed: pinned wheels, and nothing else."""

import re
import subprocess
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


@pytest.mark.parametrize("lock", ["runtime", "dev", "build"])
def test_nothing_is_pinned_that_there_is_no_wheel_of(lock):
    """On the processor that this was found on; ``make install`` would end with what else has none."""
    assert not re.search(r"(?m)^cobs==", (ROOT / f"requirements/{lock}.lock").read_text())


def test_the_readme_names_what_must_be_installed_before_the_first_command():
    readme = (ROOT / "README.md").read_text()
    assert readme.index("apt install make git python3-venv") < readme.index("make demo")
