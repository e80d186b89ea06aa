"""Writes the golden vectors: wire bytes with what they mean, for firmware authors and for the tests.

::

    python -m firmware_protocol.golden

The tests compare against the committed files, so a change of the wire cannot pass unnoticed.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from firmware_protocol.framing import PROTOCOL_VERSION
from firmware_protocol.golden_commands import command_vectors, setting_vectors
from firmware_protocol.golden_defects import defect_vectors
from firmware_protocol.golden_examples import FRAMES
from firmware_protocol.golden_forms import frame_vector
from firmware_protocol.golden_signing import signing_vectors

VECTORS = Path(__file__).parent / "vectors"

FILES = ("packets", "defects", "commands", "settings", "signing")


def packet_vectors() -> dict[str, Any]:
    """Return what ``vectors/packets.json`` holds."""
    vectors = [{"name": name, **frame_vector(frame)} for name, frame in FRAMES.items()]
    return {"protocol_version": PROTOCOL_VERSION, "vectors": vectors}


def write(folder: Path) -> None:
    """Write every file of vectors into a folder."""
    contents = (packet_vectors(), defect_vectors(), command_vectors(), setting_vectors(), signing_vectors())
    for name, content in zip(FILES, contents, strict=True):
        text = json.dumps(content, indent=1, ensure_ascii=False)
        (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(VECTORS)
