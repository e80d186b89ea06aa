"""The command that adds an extra is one that can be typed here."""

import re
import sys
import tomllib
from pathlib import Path

import pytest

from devices.extras import how_to_add

TREE = Path(__file__).resolve().parents[2]


def test_a_working_tree_adds_it_to_itself(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(tmp_path / ".venv/bin/python"))
    (tmp_path / "pyproject.toml").touch()
    monkeypatch.chdir(tmp_path)
    assert how_to_add("plot", tmp_path) == ".venv/bin/python -m pip install -e '.[plot]'"
    (tmp_path / "below").mkdir()
    monkeypatch.chdir(tmp_path / "below")
    assert how_to_add("plot", tmp_path).endswith(f"-e '{tmp_path}[plot]'")


def test_an_installed_package_goes_by_its_name(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
    assert how_to_add("plot", tmp_path) == "/usr/bin/python3 -m pip install 'mocap-gateway[plot]'"


def test_a_folder_that_is_no_more_does_not_matter(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert f"{TREE}[plot]" in how_to_add("plot")


def named_extras():
    for package in ("gateway", "devices"):
        for path in (TREE / package).rglob("*.py"):
            yield from re.findall(r"how_to_add\([\"'](\w+)[\"']", path.read_text())


@pytest.mark.parametrize("extra", sorted(set(named_extras())))
def test_every_extra_that_is_named_exists(extra):
    declared = tomllib.loads((TREE / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert extra in declared
