"""Secrets: where they come from, and that they stay there."""

from __future__ import annotations

import pytest

from gateway.settings import METRICS_TOKEN_VARIABLE, MetricsSettings
from gateway.support.credentials import AccessToken, CredentialError, is_loopback, read_secret, token_for

TOKEN = "0123456789abcdef"


def test_a_file_comes_before_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "from outside")
    file = tmp_path / "secret"
    file.write_text("from the file\nnot this line\n")
    assert read_secret(file, "SECRET", "x") == "from the file"
    assert read_secret(None, "SECRET", "x") == "from outside"
    monkeypatch.delenv("SECRET")
    assert read_secret(None, "SECRET", "x") is None


def test_an_error_names_the_file_and_not_its_content(tmp_path):
    file = tmp_path / "secret"
    file.write_bytes(b"hidden \xff")
    with pytest.raises(
        CredentialError, match=rf"cannot read token_file {file} \(not UTF-8 text\): name"
    ) as caught:
        read_secret(file, "SECRET", "token_file")
    assert "hidden" not in str(caught.value)


@pytest.mark.parametrize(
    ("host", "is_local"),
    [
        ("127.0.0.1", True),
        ("127.8.8.8", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("192.168.0.3", False),
        ("localhost.evil.example", False),
        ("127.0.0.1.evil.example", False),
    ],
)
def test_what_only_this_machine_reaches(host, is_local):
    assert is_loopback(host) is is_local


def test_a_token_matches_itself_and_shows_nothing():
    token = AccessToken(TOKEN)
    assert token.matches(TOKEN)
    for wrong in ("", None, TOKEN[:-1], f"{TOKEN} ", TOKEN.upper(), "\ud800" * 16):
        assert not token.matches(wrong)
    assert TOKEN not in f"{token!r} {token}"


@pytest.mark.parametrize(
    "text", ["", "short", "x" * 15, "with spaces in it here", "0123456789abcde\n", "é" * 16]
)
def test_a_token_that_could_be_guessed_or_misread_is_refused(text):
    with pytest.raises(CredentialError, match="16 or more letters, digits"):
        AccessToken(text)


def test_metrics_for_others_need_a_token(tmp_path, monkeypatch):
    monkeypatch.delenv(METRICS_TOKEN_VARIABLE, raising=False)
    assert MetricsSettings(port=1).token() is None
    with pytest.raises(CredentialError, match=r"open to everybody.*metrics.token_file.*MOCAP_METRICS_TOKEN"):
        MetricsSettings(port=1, host="0.0.0.0").token()
    file = tmp_path / "token"
    file.write_text(TOKEN + "\n")
    assert MetricsSettings(port=1, host="0.0.0.0", token_file=file).token().matches(TOKEN)
    monkeypatch.setenv(METRICS_TOKEN_VARIABLE, TOKEN)
    assert MetricsSettings(port=1, host="0.0.0.0").token().matches(TOKEN)


def test_a_token_given_is_asked_for_on_loopback_too(monkeypatch):
    monkeypatch.setenv("PAGE", TOKEN)
    assert token_for("the page", "127.0.0.1", None, "PAGE", "--token-file").matches(TOKEN)
