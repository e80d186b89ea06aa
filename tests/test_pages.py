"""Pages stay as long as somebody reads them."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
CODE = ("firmware_protocol", "devices", "gateway")


def test_the_readme_is_short_has_one_moving_picture_and_no_figures():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.encode()) <= 7_000
    assert len(re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)) == 1
    assert "| figure |" not in text


def test_the_page_of_all_figures_can_be_read():
    assert len((ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8").splitlines()) <= 300


def test_the_page_of_the_tree_names_every_room():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    tree = page.partition("firmware_protocol/ ")[2].partition("```")[0]
    named = set(re.findall(r"(?<![\w/])([\w]+)(?:/|\.py\b)", f"firmware_protocol/ {tree}"))
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a clone of the repository: which folders belong to it is not known")
    paths = [Path(name) for name in listed.stdout.split("\0") if "/" in name]
    rooms = {path.parts[0] for path in paths if not path.parts[0].startswith(".")}
    rooms |= {path.parts[1] for path in paths if path.parts[0] in CODE and len(path.parts) > 2}
    rooms |= {path.stem for path in (ROOT / "gateway").glob("*.py")} - {"__init__", "__main__"}
    assert sorted(rooms - named) == []


def test_diagrams_are_text_in_one_style():
    """Box-drawing characters read the same in an editor, on a hosting site and in the built pages."""
    for page in [ROOT / "README.md", *ROOT.glob("docs/**/*.md")]:
        if "_build" in page.parts:
            continue
        text = page.read_text(encoding="utf-8")
        for language, block in re.findall(r"(?ms)^```(\S*)\n(.*?)^```", text):
            assert language not in {"mermaid", "dot", "graphviz", "plantuml"}, page
            if re.search("[┌└]─", block) and "▼" in block:
                assert language == "text", page


def test_every_page_is_in_the_contents():
    contents = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    folders = {path.parent.name for path in (ROOT / "docs").glob("*/*.md")} - {"_build"}
    assert not [
        name for name in sorted(folders) if f"{name}/*" not in contents and f"{name}/README" not in contents
    ]


def test_the_citation_is_of_this_version():
    version = re.search(r'(?m)^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    cited = re.search(r"(?m)^version: (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert version is not None
    assert cited is not None
    assert cited[1] == version[1]


def test_the_forms_of_issues_can_be_read():
    forms = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    assert forms
    for form in forms:
        read = yaml.safe_load(form.read_text(encoding="utf-8"))
        assert read["name"], form
        assert read["description"], form
        assert all(field["attributes"]["label"] for field in read["body"]), form
