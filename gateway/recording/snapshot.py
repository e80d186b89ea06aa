"""What a recording tells beside the data: suit, configuration without secrets, software and host."""

from __future__ import annotations

import json
import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import yaml

import gateway
from devices import recording_format as fmt
from gateway.body.skeleton import WornSuit
from gateway.recording.suit_files import body_of, rig_of
from gateway.recording.suit_snapshot import encode_suit
from gateway.settings import GatewaySettings

REDACTED = "(not recorded)"
_SECRET = re.compile(r"(password|passphrase|secret|token|psk|api_?key)(?!_file)", re.IGNORECASE)
_LIBRARIES = ("numpy", "scipy", "numba", "llvmlite", "vqf", "mcap")


def attachments_of(settings: GatewaySettings, suit: WornSuit) -> dict[str, bytes]:
    """The attachments of a recording that begins now, by name."""
    attachments = {
        fmt.SUIT: encode_suit(suit),
        fmt.BODY: _yaml(body_of(suit.skeleton)),
        fmt.RIG: _yaml(rig_of(suit)),
        fmt.SETTINGS: json.dumps(without_secrets(settings.model_dump(mode="json")), indent=1).encode(),
        fmt.HOST: json.dumps(host(), indent=1).encode(),
    }
    if settings.clock.table is not None:
        attachments[fmt.CLOCK_TABLE] = Path(settings.clock.table).read_bytes()
    return attachments


def without_secrets(plain: Any, key: str = "") -> Any:
    """JSON values with whatever is named like a secret, and user names and passwords in URLs, taken out."""
    if isinstance(plain, dict):
        return {name: without_secrets(value, name) for name, value in plain.items()}
    if isinstance(plain, list):
        return [without_secrets(value, key) for value in plain]
    if isinstance(plain, str):
        return REDACTED if plain and _SECRET.search(key) else _without_credentials(plain)
    return plain


def _without_credentials(text: str) -> str:
    if "://" not in text or "@" not in text:
        return text
    try:
        parts = urlsplit(text)
    except ValueError:
        return REDACTED
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))


def host() -> dict[str, object]:
    """Versions and machine: what bit-identical results may depend on."""
    return {
        "gateway": gateway.__version__,
        "python": platform.python_version(),
        "implementation": sys.implementation.name,
        "libraries": {name: _version(name) for name in _LIBRARIES},
        "kernel": f"{platform.system()} {platform.release()}",
        "machine": platform.machine(),
        "processor": _processor(),
    }


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return ""


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(errors="replace").splitlines() if info.exists() else []
    named = (line.split(":", 1)[1].strip() for line in lines if line.startswith(("model name", "Model")))
    return next(named, platform.processor())


def _yaml(content: dict[str, Any]) -> bytes:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110).encode()
