"""Whoever waits for the compiler is told, and nobody else."""

import numba

from gateway.cli.compiling import told_when_compiling


def test_compiling_is_told_once_and_calling_again_is_not():
    doubled = numba.njit(lambda x: 2.0 * x)  # not kept on disk: compiled in every run of this test
    said = []
    with told_when_compiling(said.append):
        assert doubled(3.0) == 6.0
        assert doubled(3) == 6.0
    assert len(said) == 2
    assert said[0].startswith("compiling the reconstruction once")
    assert said[1].startswith("compiled (")
    said.clear()
    with told_when_compiling(said.append):
        assert doubled(4.0) == 8.0
    assert said == []
