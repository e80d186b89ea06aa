"""The document for firmware authors and the manual in the package."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent
from typing import Any

import firmware_protocol
from firmware_protocol.document import render

PACKAGE = Path(firmware_protocol.__file__).parent


def test_the_readme_is_what_the_declarations_say():
    written = (PACKAGE / "README.md").read_text(encoding="utf-8")
    assert written == render(), "run: python -m firmware_protocol.document > firmware_protocol/README.md"


def test_the_example_of_the_manual_runs():
    lines = [line for line in (firmware_protocol.__doc__ or "").splitlines() if line.startswith("    ")]
    names: dict[str, Any] = {"chunk": b""}
    exec("from firmware_protocol import *\n" + dedent("\n".join(lines)), names)
    (received,) = names["decoder"].feed(firmware_protocol.encode_frame(names["frame"]))
    assert (received.module, received.sequence) == (3, 17)
