"""Whether a method has to be compiled first."""

import subprocess

import pytest

from gateway.geometry import compiled
from gateway.reconstruction import RECONSTRUCTORS, readiness


@pytest.fixture
def created(monkeypatch, tmp_path):
    """An empty cache, and the names of the methods that were made in it."""
    names = []
    monkeypatch.setattr(compiled, "CACHE_DIRECTORY", tmp_path)
    monkeypatch.setattr(readiness, "create_reconstructor", lambda name, *_: names.append(name))
    return names


def test_a_long_compiled_method_is_ready_once_it_was_made(created):
    assert not readiness.is_ready("joint")
    readiness.make_ready("joint")
    readiness.make_ready("joint")
    assert created == ["joint"]
    assert readiness.is_ready("joint")
    assert not readiness.is_ready("outward")


def test_others_are_ready_always_and_the_fallback_is_one_of_them(created):
    for name in set(RECONSTRUCTORS) - readiness.LONG_COMPILED:
        assert readiness.is_ready(name)
    assert readiness.is_ready(readiness.FALLBACK)


def test_a_cache_that_cannot_be_written_does_no_harm(created, monkeypatch, tmp_path):
    monkeypatch.setattr(compiled, "CACHE_DIRECTORY", tmp_path / "absent")
    readiness.make_ready("joint")
    assert created == ["joint"]
    assert not readiness.is_ready("joint")


def test_an_unknown_method_is_refused_by_the_command():
    done = subprocess.run(readiness.command("magic"), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "no method is called 'magic'" in done.stderr
