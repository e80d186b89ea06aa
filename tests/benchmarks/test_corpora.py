"""Every reader of what others wrote, on good inputs, damaged ones, and those that once broke it."""

from __future__ import annotations

import pytest

from benchmarks.fuzzing.seeds import generated, seeds
from benchmarks.fuzzing.targets import CORPORA, TARGETS

FOUND = [path for target in TARGETS.values() for path in target.found]


@pytest.mark.parametrize("path", FOUND, ids=lambda path: f"{path.parent.name}: {path.name}")
def test_what_once_broke_a_check_does_so_no_more(path):
    TARGETS[path.parent.name].check()(path.read_bytes())


@pytest.mark.parametrize("name", TARGETS)
def test_no_generated_input_breaks_its_check(name):
    target = TARGETS[name]
    assert seeds(target), "a target without any good input"
    check = target.check()
    for told, data in generated(target):
        try:
            check(data)
        except Exception as error:
            raise AssertionError(f"{told} of {name} breaks it: {data!r}") from error


def test_generated_inputs_are_the_same_every_time_and_no_larger_than_the_target_takes():
    for target in TARGETS.values():
        inputs = list(generated(target))
        assert inputs == list(generated(target))
        assert max(len(data) for _, data in inputs) <= target.largest
        assert len({data for _, data in inputs}) > 0.5 * len(inputs)


def test_all_that_is_kept_once_broke_something_and_is_named_for_it():
    kept = {path for path in CORPORA.rglob("*") if path.is_file()}
    assert kept == set(FOUND)
    assert all(path.name.startswith("found_") for path in kept)
    for path in kept:
        assert path.stat().st_size <= TARGETS[path.parent.name].largest
