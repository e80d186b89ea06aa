"""What the sensitivity of the estimator is told by: every number, every rule, each once."""

from __future__ import annotations

import json

import pytest

from benchmarks import sensitivity
from benchmarks.never_worse import split
from benchmarks.sensitivity import DEFAULT, RULES, Outcome, Try, effect, recordings, tries
from gateway.reconstruction.inertial.tree.tuning import CONSTANTS


def judged(total):
    """An outcome of one recording in two variants."""
    return Outcome({"arm": "arm"}, total, total, {key: 0.5 * value for key, value in total.items()})


def test_every_constant_is_halved_and_doubled_and_every_rule_switched_off():
    by_name = {one.name: one for one in tries()}
    assert len(by_name) == 1 + 2 * len(CONSTANTS) + len(RULES)
    for name, row in CONSTANTS.items():
        assert by_name[f"{name} × 0.5"].changes == {name: 0.5 * row.default}
        assert by_name[f"{name} × 2"].changes == {name: 2.0 * row.default}


def test_rules_change_constants_that_there_are():
    assert all(rule.changes.keys() <= CONSTANTS.keys() for rule in RULES.values())
    assert all(rule.changes or rule.patch for rule in RULES.values())


def test_only_the_training_part_is_looked_at():
    chosen = recordings()
    assert set(chosen) <= {one.name for one in split.named("training")}
    assert len(chosen) == len(set(chosen)) > 10


def test_effects_are_told_in_percent_and_by_the_worst(monkeypatch):
    before, after = {"arm/field": 2.0, "arm/neither": 4.0}, {"arm/field": 4.0, "arm/neither": 4.0}
    monkeypatch.setattr(sensitivity, "objective", lambda one: sum(one.ratio.values()))
    found = effect(judged(before), judged(after))
    assert found.total == pytest.approx(100.0 * (2.0**0.5 - 1.0))
    assert (found.worst, found.where) == (pytest.approx(100.0), "arm/field")
    assert found.moves


def test_a_run_that_was_broken_off_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(sensitivity, "STORE", tmp_path / "sensitivity.json")
    asked = []

    def outcome(one, names):
        asked.append(one.name)
        return judged({"arm/field": 1.0})

    monkeypatch.setattr(sensitivity, "outcome", outcome)
    sensitivity.run([Try(DEFAULT, {})], ["arm"])
    sensitivity.run([Try(DEFAULT, {}), Try("huber × 2", {"huber": 4.0})], ["arm"])
    assert asked == [DEFAULT, "huber × 2"]
    kept = json.loads(sensitivity.STORE.read_text())
    sensitivity.STORE.write_text(json.dumps(kept | {"code": "another"}))
    assert sensitivity.known() == {}
