"""What the terminal says while a body is calibrated."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from gateway.body.rig import load_rig
from gateway.cli.calibrate_body import _Guide
from gateway.errors import GatewayError


async def test_the_wait_for_the_result_says_what_is_worked_out_and_for_how_long():
    """With nothing but a session that has been heard, and finds nothing."""

    def result():
        raise GatewayError("nothing was moved")

    said = io.StringIO()
    session = SimpleNamespace(now_ns=1, suit=load_rig("suit_17"), result=result)
    guide = _Guide(session, [], 0.0, True, asks=False)
    with pytest.raises(GatewayError, match="nothing was moved"):
        await guide.run(Console(file=said, force_terminal=True, width=250))
    assert "finding how the 17 modules sit" in said.getvalue()
    assert "some seconds" in said.getvalue()
