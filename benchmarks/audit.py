"""``python -m benchmarks.audit LOCK …``: known vulnerabilities of what is pinned.

Ends with 1 for one that is known, with 0 for none, and also with 0, saying so, when the list of advisories
cannot be reached: a machine without network is no reason to stop.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

PATIENCE_S = 300
_ADVISORIES = ("pypi", "osv")
"""Asked in turn until one answers."""


def ask(lock: Path, service: str) -> dict[str, Any] | str:
    """pip-audit's answer about a lock file, or in a line why there is none."""
    command = (sys.executable, "-m", "pip_audit", "-r", str(lock), "--disable-pip", "--require-hashes")
    options = (
        "--vulnerability-service",
        service,
        "-f",
        "json",
        "--progress-spinner",
        "off",
        "--timeout",
        "10",
    )
    try:
        done = subprocess.run(
            (*command, *options), capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {PATIENCE_S} s"
    try:
        found: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        lines = done.stderr.strip().splitlines()
        return lines[-1][:120] if lines else f"pip-audit ended with {done.returncode}"
    # A mirror without advisories answers too: every package is then "skipped", which is no audit.
    return found if audited(found) else "it knows none of the packages"


def audited(found: dict[str, Any]) -> list[str]:
    """Names of the packages that were looked up."""
    return [each["name"] for each in found.get("dependencies", ()) if "skip_reason" not in each]


def vulnerabilities(found: dict[str, Any]) -> list[str]:
    """One line for each."""
    return [
        f"{package['name']} {package['version']}: {known['id']}, mended in "
        f"{', '.join(known.get('fix_versions', ())) or 'no version yet'}"
        for package in found.get("dependencies", ())
        for known in package.get("vulns", ())
    ]


def main(locks: list[str]) -> int:
    """Ask about every lock file, and tell."""
    known: list[str] = []
    for lock in locks:
        refusals = []
        for service in _ADVISORIES:
            found = ask(Path(lock), service)
            if isinstance(found, dict):
                total = len(found["dependencies"])
                print(f"{lock}: {len(audited(found))} of {total} packages audited ({service})")
                known += vulnerabilities(found)
                break
            refusals.append(f"{service}: {found}")
        else:
            print(f"{lock}: could not reach the advisory source, not audited ({'; '.join(refusals)})")
    for line in sorted(set(known)):
        print(f"vulnerable: {line}")
    return 1 if known else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
