"""Commands that tests fork behave as those that are typed."""

from __future__ import annotations

import signal

import pytest

pytestmark = pytest.mark.system


def test_exit_code_output_and_errors_are_its_own(command):
    shown = command("config", "schema")
    assert shown.wait() == 0
    assert shown.output.startswith("{")
    assert shown.errors == ""
    wrong = command("config", "check", "/nowhere/at/all.yaml")
    assert wrong.wait() == 1
    assert "/nowhere/at/all.yaml" in wrong.errors
    assert wrong.output == ""


def test_a_signal_ends_it_and_the_environment_is_as_given(command, tmp_path):
    port = tmp_path / "suit"
    suit = command("emulate", "--rig", "single", "--on", "pty", "--link", port, "--json")
    suit.until_said("url")
    suit.send_signal(signal.SIGINT)
    assert suit.wait() == 0
    hidden = command(
        "modules", "undo", "--link", port, "--rig", "single", environment={"XDG_STATE_HOME": "x"}
    )
    assert hidden.wait() == 1
    killed = command("watch", "--port", 1)
    killed.kill()
    assert killed.wait() == -signal.SIGKILL


def test_what_never_comes_fails_with_all_that_was_written(command):
    shown = command("config", "check", "/nowhere/at/all.yaml")
    with pytest.raises(pytest.fail.Exception, match=r"waited for 'is good' in vain[\s\S]*/nowhere/at/all"):
        shown.until_said("is good")
