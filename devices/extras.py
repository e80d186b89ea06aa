"""How an extra is added to this very installation."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

_TREE = Path(__file__).resolve().parents[1]


def how_to_add(extra: str, tree: Path = _TREE) -> str:
    """Return the command to type: for a working tree its own folder, else the package by its name.

    tree: the folder that the packages are in.
    """
    python = shlex.quote(_from_here(Path(sys.executable)))
    if not (tree / "pyproject.toml").is_file():
        return f"{python} -m pip install 'mocap-gateway[{extra}]'"
    return f"{python} -m pip install -e " + shlex.quote(f"{_from_here(tree)}[{extra}]")


def _from_here(path: Path) -> str:
    """Return relative to where the user is, where it lies below."""
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, OSError):  # elsewhere, or in a folder that is no more
        return str(path)
