"""Which ids a shaken module and its segment exchange."""

from __future__ import annotations

import pytest

from gateway.modules.assignment import Wardrobe

A, B, C = ("aa" * 12, "bb" * 12, "cc" * 12)


def wardrobe(**ids):
    names = {"a": A, "b": B, "c": C}
    modules = [{"unique_id": names[name], "module": module, "answers": True} for name, module in ids.items()]
    modules += [
        {"unique_id": "ff" * 12, "module": 254, "answers": True},
        {"unique_id": "ee" * 12, "module": 9, "answers": False},
    ]
    return Wardrobe({"segments": {"pelvis": 0, "head": 1}, "modules": modules})


def test_one_with_the_right_id_stays():
    proposal = wardrobe(a=0, b=1).propose("pelvis", A)
    assert proposal.is_right_already
    assert proposal.ids == {A: 0}
    assert str(proposal) == "it is module 0 already"


def test_one_that_does_not_answer_can_be_given_no_id():
    with pytest.raises(KeyError):
        wardrobe(a=0).propose("pelvis", "ee" * 12)


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
