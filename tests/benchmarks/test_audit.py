"""The audit of dependencies: red for what is known, green without network, never green in silence."""

from __future__ import annotations

import json
import subprocess

import pytest

from benchmarks import audit

SOUND = {"dependencies": [{"name": "numpy", "version": "2.0", "vulns": []}]}
VULNERABLE = {
    "dependencies": [
        {"name": "pyyaml", "version": "5.3", "vulns": [{"id": "PYSEC-2020-96", "fix_versions": ["5.3.1"]}]},
        {"name": "left", "version": "1", "vulns": [{"id": "X-1", "fix_versions": []}]},
    ]
}
UNKNOWN = {"dependencies": [{"name": "numpy", "skip_reason": "Dependency not found"}]}


@pytest.fixture
def answering(monkeypatch):
    """pip-audit answers, per service: a JSON object, or an error text."""

    def answer(**answers):
        def run(command, **_):
            given = answers[command[command.index("--vulnerability-service") + 1]]
            if isinstance(given, str):
                return subprocess.CompletedProcess(command, 1, "", f"Traceback\n{given}\n")
            return subprocess.CompletedProcess(command, 0, json.dumps(given), "")

        monkeypatch.setattr(subprocess, "run", run)

    return answer


def test_a_known_vulnerability_fails_and_is_named(answering, capsys):
    answering(pypi=VULNERABLE, osv=SOUND)
    assert audit.main(["runtime.lock", "dev.lock"]) == 1
    out = capsys.readouterr().out
    assert out.count("vulnerable: pyyaml 5.3: PYSEC-2020-96, mended in 5.3.1") == 1
    assert "vulnerable: left 1: X-1, mended in no version yet" in out


def test_nothing_known_passes(answering, capsys):
    answering(pypi=SOUND, osv="never asked")
    assert audit.main(["runtime.lock"]) == 0
    assert "1 of 1 packages audited (pypi)" in capsys.readouterr().out


def test_without_network_it_says_so_and_passes(answering, capsys):
    answering(pypi=UNKNOWN, osv="ConnectionError: name not known")
    assert audit.main(["runtime.lock"]) == 0
    out = capsys.readouterr().out
    assert "could not reach the advisory source, not audited" in out
    assert "pypi: it knows none of the packages; osv: ConnectionError: name not known" in out


def test_the_second_source_is_asked_when_the_first_knows_nothing(answering, capsys):
    answering(pypi=UNKNOWN, osv=VULNERABLE)
    assert audit.main(["runtime.lock"]) == 1
    assert "2 of 2 packages audited (osv)" in capsys.readouterr().out
