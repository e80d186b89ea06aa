"""Whoever waits for the compiler is told, and nobody else."""

import contextlib
import re
import signal

import numba
import pytest

from gateway.cli import preparing
from gateway.cli.preparing import report_compiling
from gateway.service import readiness


def test_compiling_is_told_once_and_calling_again_is_not():
    doubled = numba.njit(lambda x: 2.0 * x)  # not kept on disk: compiled in every run of this test
    said = []
    with report_compiling(said.append):
        assert doubled(3.0) == 6.0
        assert doubled(3) == 6.0
    assert len(said) == 2
    assert said[0].startswith("compiling the reconstruction once")
    assert said[1].startswith("compiled (")
    said.clear()
    with report_compiling(said.append):
        assert doubled(4.0) == 8.0
    assert said == []


def test_ctrl_c_that_the_compiler_lost_ends_the_work_all_the_same():
    before = signal.getsignal(signal.SIGINT)

    def compile_interrupted() -> None:
        with report_compiling(lambda _: None):
            with contextlib.suppress(KeyboardInterrupt):  # as within a callback
                signal.raise_signal(signal.SIGINT)
            raise RuntimeError("no compiled object yet")

    with pytest.raises(KeyboardInterrupt):
        compile_interrupted()
    assert signal.getsignal(signal.SIGINT) is before


def test_other_errors_are_told_as_they_are():
    with pytest.raises(RuntimeError, match="other"), report_compiling(lambda _: None):
        raise RuntimeError("other")


@pytest.mark.parametrize("is_terminal", [False, True])
def test_compiling_a_method_tells_each_step_where_no_bar_can_be_drawn(is_terminal, monkeypatch, capsys):
    def make_ready(_name, *, progress):
        for done in range(3):
            progress(done, 2)

    monkeypatch.setattr(readiness, "is_ready", lambda _: False)
    monkeypatch.setattr(readiness, "make_ready", make_ready)
    monkeypatch.setattr("sys.stderr.isatty", lambda: is_terminal)
    preparing.make_ready("joint")
    said = re.sub(r" ?\(\d+ s\)", "", capsys.readouterr().err)
    assert said.startswith("compiling the method 'joint': once after an installation\n")
    steps = "compiling: step 1 of 2\ncompiling: step 2 of 2\n"
    assert (steps in said) != is_terminal
    assert "compiled" in said
