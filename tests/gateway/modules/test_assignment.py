"""Which ids a shaken module and its segment exchange; and what stood there before is kept."""

from __future__ import annotations

import pytest

from devices.configure import Change
from gateway.modules.assignment import Wardrobe
from gateway.modules.journal import Journal

A, B, C = ("aa" * 12, "bb" * 12, "cc" * 12)


def wardrobe(**ids):
    names = {"a": A, "b": B, "c": C}
    modules = [{"unique_id": names[name], "module": module} for name, module in ids.items()]
    modules += [{"unique_id": "ff" * 12, "module": 254}, {"unique_id": None, "module": 9}]
    return Wardrobe({"segments": {"pelvis": 0, "head": 1}, "modules": modules})


def test_one_with_the_right_id_stays():
    proposal = wardrobe(a=0, b=1).propose("pelvis", A)
    assert proposal.is_right_already
    assert proposal.ids == {A: 0}
    assert str(proposal) == "it is module 0 already"


def test_a_free_id_is_taken():
    proposal = wardrobe(a=17, b=1).propose("pelvis", A)
    assert proposal.ids == {A: 0}
    assert str(proposal) == "it becomes module 0"


def test_whoever_has_the_id_gets_the_other_in_exchange():
    worn = wardrobe(a=1, b=0, c=5)
    proposal = worn.propose("pelvis", A)
    assert proposal.ids == {A: 0, B: 1}
    assert str(proposal) == f"it becomes module 0, and module 0 ({B}) becomes module 1"
    worn.note([{"unique_id": A, "after": {"module_id": 0}}, {"unique_id": B, "after": {"module_id": 1}}])
    assert worn.propose("head", B).is_right_already


def test_a_module_that_was_not_heard_is_an_error():
    with pytest.raises(KeyError):
        wardrobe(a=0).propose("pelvis", B)


def test_a_journal_outlives_the_program_and_is_taken_back_last_first(tmp_path):
    path = tmp_path / "deep" / "module_changes.json"
    first = Change(b"a" * 12, {"label": "", "calibration": (1.0, 2.0)}, {"label": "x"})
    second = Change(b"b" * 12, {"module_id": 3}, {"module_id": 5})
    journal = Journal(path)
    journal.record([first])
    journal.record([second])
    again = Journal(path)
    assert again.last() == [second]
    again.drop_last()
    (kept,) = Journal(path).last()
    assert kept.unique_id == first.unique_id
    assert kept.before == {"label": "", "calibration": [1.0, 2.0]}
    again.drop_last()
    assert Journal(path).last() == []


def test_a_journal_that_cannot_be_kept_on_disk_still_works(tmp_path, caplog):
    (tmp_path / "file").write_text("")
    journal = Journal(tmp_path / "file" / "journal.json")
    change = Change(b"a" * 12, {"module_id": 3}, {"module_id": 5})
    journal.record([change])
    assert journal.last() == [change]
    assert "can be undone in this run only" in caplog.text


def test_a_damaged_journal_is_said_and_begun_anew(tmp_path, caplog):
    path = tmp_path / "journal.json"
    path.write_text("{not json")
    assert Journal(path).last() == []
    assert "cannot be undone" in caplog.text
