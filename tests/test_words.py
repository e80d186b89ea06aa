"""Words that the field does not use, or that this project has given up, stay out of code and documents."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RETIRED = {
    "gyrometer": "gyroscope",
    "habits": "motion statistics",
    "misfit": "normalised innovation squared (NIS)",
}
"""Word to what is said instead."""
ALLOWED = {
    "gateway/support/former_names.py": "reads files of the release before",
    "tests/gateway/test_former_names.py": "writes such files",
    "tests/test_words.py": "names them",
    "CHANGELOG.md": "says what was renamed",
}
"""File to why a retired word stands there."""
_TEXTS = (".py", ".md", ".yaml", ".json", ".toml", ".c", ".h", ".ino", ".js", ".html", ".sh")


def test_no_retired_word_is_used():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a clone of the repository: which files belong to it is not known")
    names = [name for name in listed.stdout.split("\0") if name.endswith(_TEXTS) and name not in ALLOWED]
    assert len(names) > 500
    retired = re.compile("|".join(RETIRED), re.IGNORECASE)
    found = [
        f"{name}:{number}: say '{RETIRED[word[0].lower()]}', not '{word[0]}'"
        for name in names
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), 1)
        for word in [retired.search(line)]
        if word
    ]
    assert not found, "\n".join(found)
