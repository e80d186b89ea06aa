"""Names of files with what looks like terminal markup are printed as they are."""

from tests.typed_here import typed_here

NAME = "a[/red] [bold]ü"


def test_a_configuration_that_is_good(tmp_path):
    path = tmp_path / f"{NAME}.yaml"
    path.parent.mkdir()
    path.write_text("rig: single\nreconstructor: independent\nlinks: [{name: a, url: 'tcp://127.0.0.1:1'}]\n")
    code, output, errors = typed_here(["config", "check", path])
    assert (code, errors) == (0, "")
    assert f"{path} is good" in output


def test_a_new_key(tmp_path):
    path = tmp_path / f"{NAME}.key"
    path.parent.mkdir()
    code, output, _ = typed_here(["config", "key", path])
    assert code == 0
    assert f"{path} holds a new key" in output
    assert f"key_file={path}" in output
