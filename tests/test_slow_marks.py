"""A test that is left out of the fast run says why."""

from types import SimpleNamespace

import pytest

from tests.fixtures.slow_marks import pytest_collection_modifyitems


def marked(*marks):
    """A collected test with these marks."""
    named = {mark.name: [mark.mark] for mark in marks}
    return SimpleNamespace(nodeid="test_a.py::test_b", iter_markers=lambda name: named.get(name, []))


def test_a_reason_suffices():
    pytest_collection_modifyitems([marked(pytest.mark.slow(reason="an hour of walking")), marked()])


@pytest.mark.parametrize("mark", [pytest.mark.slow, pytest.mark.slow("why"), pytest.mark.slow(reason=" ")])
def test_without_a_reason_nothing_is_collected(mark):
    with pytest.raises(pytest.UsageError, match=r"test_a\.py::test_b is left out of `make test`: say why"):
        pytest_collection_modifyitems([marked(mark)])
