"""YAML that is out to harm, and YAML that only looks odd."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.emulators.faults.fault_plan import FaultPlan
from gateway.errors import SettingsError
from gateway.settings import load_gateway_settings
from gateway.support import yaml_text
from gateway.support.settings_files import load_settings, load_yaml

LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)
HARMFUL = {
    "billion laughs": (LAUGHS, "more than 200000 values"),
    "merged laughs": (
        "a0: &a0 {a: 1, b: 2}\n"
        + "".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 12)),
        "more than 200000 values",
    ),
    "a list in itself": ("a: &a [*a]\n", "an alias stands inside what it names"),
    "a deep list": ("a: " + "[" * 300, "more than 40 deep"),
    "a deep block": ("\n".join("  " * i + "a:" for i in range(60)), "more than 40 deep"),
    "code": ("!!python/object/apply:os.system ['true']\n", "could not determine a constructor"),
    "a name twice": ("rig: a\nbody: b\nrig: c\n", "line 3, column 1 'rig' stands here and in line 1"),
    "a tab": ("rig: a\n\tbody: b\n", "indent with spaces"),
    "a long number": ("a: " + "1" * 5000, "a value cannot be read"),
    "a date of no calendar": ("a: 2026-99-99\n", "a value cannot be read"),
}


@pytest.mark.parametrize("name", HARMFUL)
def test_harm_is_refused_in_one_short_line(name, tmp_path):
    text, reason = HARMFUL[name]
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=reason) as caught:
        load_yaml(path)
    assert len(str(caught.value)) < 400
    assert str(caught.value).startswith(str(path))


def test_a_file_that_is_something_else(tmp_path):
    path = tmp_path / "file.yaml"
    path.write_bytes(b"rig: su\xeft\n")
    with pytest.raises(SettingsError, match=r"no text in UTF-8.*: save it as UTF-8"):
        load_yaml(path)
    path.write_bytes(b"#" * (yaml_text.LARGEST_TEXT + 1))
    with pytest.raises(SettingsError, match="larger than 4 MiB: it is another file"):
        load_yaml(path)


def test_aliases_that_people_write_are_read():
    text = "base: &base {unit: g}\none: *base\ntwo: {<<: *base, more: 1}\n"
    assert yaml_text.load(text) == {
        "base": {"unit": "g"},
        "one": {"unit": "g"},
        "two": {"unit": "g", "more": 1},
    }
    assert yaml_text.load("") is None


TEXTS = st.text(st.characters(codec="utf-8"))
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("abc"), inner, max_size=4),
    max_leaves=20,
)


@settings(max_examples=40, deadline=None)
@given(PLAIN)
def test_plain_values_are_read_as_the_safe_loader_reads_them(value):
    text = yaml.safe_dump(value)
    assert yaml_text.load(text) == yaml.safe_load(text)


@pytest.mark.parametrize("name", ["Gateway", "GATEWAY", "[odd]", "X" * 5000])
def test_found_by_fuzzing_a_setting_that_begins_with_a_capital(name, tmp_path):
    """It was taken for the tag of a union, and the error message failed with IndexError."""
    path = tmp_path / "gateway.yaml"
    path.write_text(yaml.safe_dump({name: 1, "rig": "single"}))
    with pytest.raises(SettingsError, match="unknown setting '") as caught:
        load_gateway_settings(path)
    assert name[:40] in str(caught.value)
    assert max(map(len, str(caught.value).splitlines())) < 600


def test_errors_do_not_repeat_a_whole_file(tmp_path):
    path = tmp_path / "gateway.yaml"
    path.write_text(f"rig: {{x: {'y' * 100_000}}}\nlinks: {[{'a': 1}] * 500}\n")
    with pytest.raises(SettingsError, match="more like these") as caught:
        load_gateway_settings(path)
    assert len(str(caught.value)) < 20_000


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "is empty: 'key: value' lines are wanted"),
        ("faults: [{kind: loss, at: 1, shore: 0.2}]", r"'faults\.0\.loss\.shore' \(did you mean 'share'"),
        ("faults: [{kind: reset, at: 1, zz: 2}]", r"'faults\.0\.reset\.zz' \(known: at, .*module"),
    ],
)
def test_a_list_of_several_kinds_tells_what_its_kind_knows(text, told, tmp_path):
    path = tmp_path / "faults.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=told):
        load_settings(path, FaultPlan)
