"""The annotated configuration that users copy: every choice in it can be taken by removing one ``#``."""

import re
from pathlib import Path

import pytest

from gateway.settings import GatewaySettings, load_gateway_settings

SHIPPED = Path(__file__).resolve().parents[2] / "config" / "gateway.yaml"
LINES = SHIPPED.read_text().splitlines()
CHOICE = re.compile(r"^(\s+)# ((?:- )?\{?(\w+): .+)$")
CHOICES = [number for number, line in enumerate(LINES) if CHOICE.match(line)]
GOES_WITH = {"table": ("  mode: estimated", "  mode: table")}
"""What a choice needs beside it, as its explanation says."""


def uncommented(number):
    """Take one choice: its ``#`` goes, and so does the line that gives the same setting another value."""
    indent, text, name = CHOICE.match(LINES[number]).groups()
    lines = [*LINES[:number], indent + text, *LINES[number + 1 :]]
    old, new = GOES_WITH.get(name, ("", ""))
    others = {} if text.startswith("- ") else {indent + name, f"{indent[:-2]}- {name}"}
    return "\n".join(
        new if line.startswith(old) and old else line
        for k, line in enumerate(lines)
        if k == number or line.partition(":")[0] not in others
    )


def test_there_are_choices():
    assert len(CHOICES) > 15


@pytest.mark.parametrize("number", CHOICES, ids=lambda number: LINES[number].split(":")[0].strip("# -{"))
def test_each_choice_can_be_uncommented(number, tmp_path):
    changed = tmp_path / "gateway.yaml"
    changed.write_text(uncommented(number))
    (tmp_path / "suit_17.clocks.yaml").write_text("{}")
    assert load_gateway_settings(changed) != load_gateway_settings(SHIPPED)


def test_a_section_of_comments_alone_is_left_out():
    given = {"links": [{"name": "suit", "url": "/dev/ttyUSB0"}], "rig": "suit_17"}
    empty = given | {"outputs": None, "metrics": None}
    assert GatewaySettings.model_validate(empty) == GatewaySettings.model_validate(given)
    with pytest.raises(ValueError, match="links"):
        GatewaySettings.model_validate(given | {"links": None})
