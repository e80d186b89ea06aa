"""A wrong value of an option is answered with what is wanted, in words that are not Python's."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from gateway.cli.main import app
from gateway.errors import GatewayError
from gateway.support.whole_files import remedy_of


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("demo --seconds abc", "'--seconds': 'abc': a number is wanted"),
        ("demo --seconds 1", "'--seconds': '1': at least 5 is wanted"),
        ("demo --port 70000", "'--port': '70000': at most 65535 is wanted"),
        ("emulate --rate nan", "'--rate': 'nan': that is not a number"),
        ("watch --protocol nan", "'--protocol': 'nan' is not one of"),
        ("watch --count 1.5", "'--count': '1.5': a whole number is wanted"),
        ("watch --protocol 4", "'--protocol': '4' is not one of"),
        ("export x.mcap --to xyz", "'--to': 'xyz' is not one of 'bvh', 'c3d'"),
        ("fleet archive expire --archive a --before soon", "'--before': 'soon' is no date, YYYY-MM-DD"),
    ],
)
def test_a_wrong_value_is_named_with_its_option_and_what_is_wanted(words, told, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    shown = CliRunner().invoke(app, words.split())
    assert shown.exit_code == 2
    assert told in shown.output
    assert "Input should" not in shown.output


def test_a_folder_in_the_place_of_a_file_to_write_is_said_so(tmp_path):
    shown = CliRunner().invoke(app, ["config", "dbc", "--force", "--output", str(tmp_path)])
    assert isinstance(shown.exception, OSError)
    assert "name a file in it" in str(remedy_of(shown.exception))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("watch --gateway a/b --port 1", "gateway name 'a/b' must not be empty"),
        ("health --host no/such --timeout 1", "no gateway answers at"),
        ("health --host a\x01b", "no gateway answers at"),
        ("video solve --cameras none.yaml left=", "names no film: write FILE or CAMERA=FILE"),
        ("body show human_17 --height 182", "--height (m) 182.0: less than 2.6 is wanted"),
        ("body show human_17 --length thigh=long", "--length (m) 'long': a number is wanted"),
        ("body import-urdf /tmp -o out.yaml", "/tmp: is a folder: name the file in it"),
    ],
)
def test_a_value_of_another_kind_is_an_error_of_the_users_own(words, told):
    """Not of ours, with all that led to it."""
    shown = CliRunner().invoke(app, words.split())
    assert isinstance(shown.exception, GatewayError)
    assert told in str(shown.exception)
    assert "Errno" not in str(shown.exception)
