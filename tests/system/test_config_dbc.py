"""``mocap-gateway config dbc``: the file that a bus monitor reads, for a suit's modules."""

import re

import pytest

from firmware_protocol.dbc import PATH, render
from tests.typed_here import typed_here


def test_it_is_of_the_modules_named(tmp_path):
    file = tmp_path / "suit.dbc"
    code, out, _ = typed_here(["config", "dbc", "--modules", "1-3, 60,2,254", "-o", str(file)])
    assert code == 0
    assert "5 module(s)" in out
    assert file.read_text(encoding="ascii") == render((1, 2, 3, 60, 254))


def test_it_is_of_a_whole_suit_unless_told_otherwise_and_of_module_0_as_the_repository_has_it(tmp_path):
    file = tmp_path / "suit.dbc"
    assert typed_here(["config", "dbc", "-o", str(file)])[0] == 0
    assert file.read_text(encoding="ascii") == render(range(17))
    assert typed_here(["config", "dbc", "--modules", "0", "--force", "-o", str(file)])[0] == 0
    assert file.read_bytes() == PATH.read_bytes()


def test_a_file_that_is_there_is_replaced_only_when_told_so(tmp_path):
    file = tmp_path / "README.md"
    file.write_text("not to be lost")
    code, _, err = typed_here(["config", "dbc", "-o", str(file)])
    assert code == 1
    assert "exists: name another file with --output, or replace it with --force" in err
    assert file.read_text() == "not to be lost"


def test_samples_hold_the_sensors_that_are_named(tmp_path):
    file = tmp_path / "suit.dbc"
    names = ["angular_rate", "specific_force"]
    options = [word for name in names for word in ("--sensor", name)]
    assert typed_here(["config", "dbc", "--modules", "5", *options, "-o", str(file)])[0] == 0
    assert file.read_text(encoding="ascii") == render((5,), names)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--modules", "3-1"], r"--modules 3-1: '3-1' names no modules; ids are 0 to 63, and 254"),
        (["--modules", "0-64"], r"'0-64' names no modules"),
        (["--modules", "0,,2"], r"'' names no modules"),
        (["--modules", "all"], r"'all' names no modules"),
        (["--modules", "²"], r"'²' names no modules"),
        (["--sensor", "angular_rates"], r"--sensor angular_rates: .*did you mean 'angular_rate'"),
    ],
)
def test_what_names_nothing_is_refused_and_writes_nothing(tmp_path, options, said):
    file = tmp_path / "suit.dbc"
    code, _, err = typed_here(["config", "dbc", *options, "-o", str(file)])
    assert code == 1
    assert re.search(said, err), err
    assert not file.exists()
