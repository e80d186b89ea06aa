"""What the count of the tree finds."""

import textwrap

from benchmarks import structure


def test_nothing_in_production_is_used_by_tests_alone():
    assert structure.used_by_tests_alone() == []


def test_what_tests_alone_use_is_found_with_what_only_that_uses(tmp_path, monkeypatch):
    files = {
        "gateway/a.py": """
            def used(): ...
            def tested(): return inner()
            def inner(): ...
            class Kept:
                def looked_at(self): ...
                def called(self): ...
            Kept().called(), used()
            """,
        "devices/emulators/b.py": "def shared(): ...",
        "tests/test_a.py": "def test(): tested(), inner(), shared(), used(), Kept().looked_at",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(textwrap.dedent(text))
    monkeypatch.setattr(structure, "REPOSITORY", tmp_path)
    assert structure.used_by_tests_alone() == [
        f"gateway/a.py: {name}" for name in ("inner", "looked_at", "tested")
    ]
