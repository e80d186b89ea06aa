"""Secrets: from a file or the environment, never from a command line or a configuration, never in a log."""

from __future__ import annotations

import hmac
import ipaddress
import os
import urllib.parse
from pathlib import Path

from gateway.errors import SettingsError

SHORTEST_TOKEN = 16
"""Characters. Enough that guessing over a network is hopeless."""
_LARGEST_FILE = 4096
"""Bytes of a file of a secret: a longer one is another file."""


class CredentialError(SettingsError, ValueError):
    """A secret cannot be read. ``str(error)`` names the file, never its content."""


def read_secret(file: Path | None, variable: str, setting: str) -> str | None:
    """Return first line of ``file``, else the environment variable, else None.

    setting: what named the file, for the error. Raises ``CredentialError``.
    """
    if file is None:
        return os.environ.get(variable)
    try:
        with file.open(encoding="utf-8") as opened:
            # Bounded, as the name may be of a device that never ends.
            lines = opened.read(_LARGEST_FILE).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise CredentialError(
            f"cannot read {setting} {file} ({reason}): name a file that this user may read"
        ) from None
    return lines[0] if lines else ""


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches what listens there."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def leads_here(address: str) -> bool:
    """Return whether an address (``http://NAME:PORT``, ``//NAME``) has a name of this machine."""
    try:
        return is_loopback(urllib.parse.urlsplit(address).hostname or "")
    except ValueError:
        return False


class AccessToken:
    """What somebody must show to be let in. Neither printed nor compared in a time that depends on it."""

    def __init__(self, text: str) -> None:
        """Keep a token.

        Raises ``CredentialError`` for one that could be guessed or cannot stand in an address.
        """
        if (
            len(text) < SHORTEST_TOKEN
            or not text.isascii()
            or not text.replace("-", "").replace("_", "").isalnum()
        ):
            raise CredentialError(
                f"a token is {SHORTEST_TOKEN} or more letters, digits, '-' and '_' "
                "(python3 -c 'import secrets; print(secrets.token_urlsafe())' makes one)"
            )
        self._bytes = text.encode()

    def __repr__(self) -> str:
        return "AccessToken(…)"

    def reveal(self) -> str:
        """Return the token itself, for handing it to a child process."""
        return self._bytes.decode()

    def matches(self, given: str | None) -> bool:
        """Return whether it is this one; the time taken does not depend on how much of it is right."""
        return hmac.compare_digest(self._bytes, (given or "").encode(errors="replace"))


def token_for(what: str, host: str, file: Path | None, variable: str, setting: str) -> AccessToken | None:
    """Return the token of something that listens at ``host``; None: none was given, and none is needed.

    what: for the error. Raises ``CredentialError`` where others than this machine could come in without one.
    """
    text = read_secret(file, variable, setting)
    if text is not None:
        return AccessToken(text)
    if is_loopback(host):
        return None
    raise CredentialError(
        f"{what} at {host} would be open to everybody in the network: give it a token ({setting}, or the "
        f"environment variable {variable}), or let it listen at 127.0.0.1"
    )
