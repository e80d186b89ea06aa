"""The kernel cache must not outlive a change of the kernels."""

import os

from gateway.geometry import compiled as module
from gateway.geometry.compiled import cache_directory, compiled, prune, source_fingerprint


def test_fingerprint_follows_every_file_with_kernels_and_no_other(tmp_path):
    kernels = tmp_path / "kernels.py"
    kernels.write_text("from gateway.geometry.compiled import compiled\nA = 1\n")
    other = tmp_path / "other.py"
    other.write_text("A = 1\n")
    before = source_fingerprint(tmp_path)
    other.write_text("A = 2\n")
    assert source_fingerprint(tmp_path) == before
    kernels.write_text("from gateway.geometry.compiled import compiled\nA = 2\n")
    assert source_fingerprint(tmp_path) != before


def test_cache_lies_where_the_environment_says(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert cache_directory(tmp_path).parent == tmp_path


def test_cache_of_a_read_only_package_lies_with_the_user(tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(module.os, "access", lambda path, mode: False)
    assert cache_directory(tmp_path / "package").parent == tmp_path / "mocap-gateway"


def test_division_by_zero_does_not_raise():
    def quotient(a, b):
        return a / b

    assert compiled(quotient)(1.0, 0.0) == float("inf")


def test_only_the_newest_caches_are_kept(tmp_path):
    for age in range(6):
        folder = tmp_path / f"kernels-{age}"
        folder.mkdir()
        (folder / "kernel.nbc").write_bytes(b"code")
        os.utime(folder, (1000 - age, 1000 - age))
    (tmp_path / "other").mkdir()
    prune(tmp_path / "kernels-5", kept=2)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "kernels-0",
        "kernels-1",
        "kernels-5",
        "other",
    ]
