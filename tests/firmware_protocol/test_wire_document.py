"""The document for firmware authors and the manual in the package."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent
from typing import Any

import firmware_protocol
from firmware_protocol.document import render
from firmware_protocol.messages import DEVICE_INFO_INTERVAL_S

PACKAGE = Path(firmware_protocol.__file__).parent


def test_the_readme_is_what_the_declarations_say():
    written = (PACKAGE / "README.md").read_text(encoding="utf-8")
    assert written == render(), "run: python -m firmware_protocol.document > firmware_protocol/README.md"


def test_all_pages_and_examples_say_who_they_are_as_often():
    repository = PACKAGE.parent
    guide = (repository / "docs" / "guide" / "firmware.md").read_text(encoding="utf-8")
    sketch = (repository / "examples/arduino/imu_module/imu_module.ino").read_text(encoding="utf-8")
    assert f"every {DEVICE_INFO_INTERVAL_S:g} s" in render()
    assert f"at the start, then every {DEVICE_INFO_INTERVAL_S:g} s" in guide
    assert f"INFO_INTERVAL_US = {DEVICE_INFO_INTERVAL_S * 1e6:.0f};" in sketch


def test_the_example_of_the_manual_runs():
    lines = [line for line in (firmware_protocol.__doc__ or "").splitlines() if line.startswith("    ")]
    names: dict[str, Any] = {"chunk": b""}
    exec("from firmware_protocol import *\n" + dedent("\n".join(lines)), names)
    (received,) = names["decoder"].feed(firmware_protocol.encode_frame(names["frame"]))
    assert (received.module, received.sequence) == (3, 17)
