"""A LiteRT model: one picture in, named tensors out."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from devices.extras import how_to_add
from gateway.errors import GatewayError

FloatTensor = NDArray[np.float32]


class LiteModel:
    """One loaded .tflite file."""

    def __init__(self, path: Path, threads: int) -> None:
        """Read a model. Raises ``GatewayError`` when the extra ``video`` is missing or the file is no
        model."""
        try:
            from ai_edge_litert.interpreter import Interpreter  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise GatewayError(f"ai-edge-litert is not installed: {how_to_add('video')} adds it") from error
        try:
            with _without_chatter():
                self._interpreter = Interpreter(str(path), num_threads=threads)
                self._interpreter.allocate_tensors()
        except (ValueError, RuntimeError) as error:
            raise GatewayError(f"{path}: is no model that LiteRT reads: {error}") from error
        self._input = self._interpreter.get_input_details()[0]
        self._outputs = {each["name"]: each["index"] for each in self._interpreter.get_output_details()}

    @property
    def size(self) -> int:
        """Rows and columns of its picture."""
        return int(self._input["shape"][1])

    def run(self, picture: FloatTensor, *names: str) -> tuple[FloatTensor, ...]:
        """Return the outputs of those names for a picture (rows, columns, 3)."""
        self._interpreter.set_tensor(self._input["index"], picture[None])
        self._interpreter.invoke()
        return tuple(self._interpreter.get_tensor(self._outputs[name]) for name in names)


@contextlib.contextmanager
def _without_chatter() -> Iterator[None]:
    """Keep quiet what LiteRT writes to standard error, past Python, which delegate it has made: nobody
    asked."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
