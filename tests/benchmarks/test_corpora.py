"""Every input that the fuzzer kept, again: those that once broke something are called ``found_…``."""

from __future__ import annotations

import pytest

from benchmarks.fuzzing.targets import CORPORA, TARGETS

LARGEST_ALTOGETHER = 2_000_000


@pytest.mark.parametrize("name", TARGETS)
def test_no_input_of_the_corpus_breaks_its_check(name):
    target = TARGETS[name]
    assert target.corpus, "a target without any input"
    check = target.check()
    for path in target.corpus:
        try:
            check(path.read_bytes())
        except Exception as error:
            raise AssertionError(f"{path.name} breaks {name}") from error


def test_the_corpora_stay_small():
    sizes = {path: path.stat().st_size for path in CORPORA.rglob("*") if path.is_file()}
    assert sum(sizes.values()) < LARGEST_ALTOGETHER
    for path, size in sizes.items():
        assert size <= TARGETS[path.parent.name].largest, path
