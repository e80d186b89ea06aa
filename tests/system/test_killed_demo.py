"""A demo that is killed takes with it what it has started."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile

import psutil
import pytest

from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system


def test_what_a_demo_has_started_ends_when_it_is_killed(unused_port, monkeypatch, tmp_path):
    """Suit, broker and page: they ran on for ever, each with a part of a core."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    typed = [sys.executable, "-m", "gateway", "demo", "--seconds", "600", "--port", str(unused_port)]
    demo = subprocess.Popen(typed, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert demo.stdout is not None
    assert any(re.match(r"pose +\d", line) for line in demo.stdout)
    started = psutil.Process(demo.pid).children(recursive=True)
    demo.kill()
    _, left = psutil.wait_procs(started, PATIENCE_S)
    for process in left:
        process.kill()
    demo.wait()
    demo.stdout.close()
    assert started
    assert not left
