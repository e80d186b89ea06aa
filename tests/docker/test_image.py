"""The image, built without an engine on a base of Debian's own, and the service run in it as its user.

buildah's chroot isolation needs no cgroups and no network of its own; debootstrap makes the base, since no
image registry is needed then. Where either is missing the test says so.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
BASE = "localhost/python-base"
IMAGE = "localhost/mocap-gateway"
PACKAGES = "python3,python3-venv,python-is-python3,ca-certificates"
CERTIFICATES = "/etc/ssl/certs"
NEEDED = ("buildah", "debootstrap")
MISSING = [program for program in NEEDED if shutil.which(program) is None]

pytestmark = [
    pytest.mark.slow(reason="builds a root file system and the image, ten minutes and a network"),
    pytest.mark.timeout(3600),
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: apt install {' '.join(MISSING)}"),
    pytest.mark.skipif(os.geteuid() != 0, reason="a root file system is made by root only"),
]


class Builder:
    """buildah with a store of its own."""

    def __init__(self, folder: Path) -> None:
        self._options = ["--root", f"{folder}/store", "--runroot", f"{folder}/run"]
        self._environment = os.environ | {"STORAGE_DRIVER": "vfs", "BUILDAH_ISOLATION": "chroot"}

    def __call__(self, *command: str | Path) -> str:
        words = ["buildah", *self._options, *map(str, command)]
        done = subprocess.run(
            words, capture_output=True, text=True, check=False, cwd=REPOSITORY, env=self._environment
        )
        assert done.returncode == 0, f"{' '.join(words)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
        return done.stdout


@pytest.fixture(scope="module")
def container(tmp_path_factory):
    """(builder, container) of the finished image."""
    folder = tmp_path_factory.mktemp("image")
    root = folder / "base"
    make_base = ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", "bookworm", str(root)]
    done = subprocess.run(make_base, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no Debian base could be made: {done.stdout.strip().splitlines()[-1:]}")
    builder = Builder(folder)
    scratch = builder("from", "scratch").strip()
    builder("add", "-q", scratch, root, "/")
    builder("commit", "-q", "--rm", scratch, BASE)
    builder(
        "bud", "--isolation", "chroot", "--pull-never", "--format", "docker", "--build-arg", f"BASE={BASE}",
        "-v", f"{CERTIFICATES}:{CERTIFICATES}:ro", "-f", "docker/Dockerfile", "-t", IMAGE, ".",
    )  # fmt: skip
    yield builder, builder("from", "--pull-never", IMAGE).strip()
    shutil.rmtree(folder, ignore_errors=True)


def run_in(container, *command: str) -> str:
    builder, name = container
    return builder("run", "--isolation", "chroot", name, "--", *command)


def test_it_runs_as_a_user_without_privileges(container):
    assert run_in(container, "id", "-u").strip() == "10001"
    assert "dialout" in run_in(container, "id", "-Gn", "mocap")
    assert run_in(container, "tini", "--", "mocap-gateway", "--version").strip()


def test_a_body_is_reconstructed_in_it(container):
    said = run_in(
        container, "tini", "--", "mocap-gateway", "demo", "--seconds", "8", "--no-page", "--port", "18830"
    )
    assert "poses received over MQTT" in said
    assert "pelvis" in said


def test_health_is_asked_with_its_configuration(container):
    builder, _ = container
    looked = builder("inspect", "--type", "image", "--format", "{{.Docker.Config.Healthcheck}}", IMAGE)
    assert "mocap-gateway" in looked
    assert "health" in looked
