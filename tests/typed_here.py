"""The whole program, typed in this process: starting Python takes longer than most commands."""

from __future__ import annotations

import contextlib
import io
import logging
import sys
import threading
from collections.abc import Sequence

import pytest

from gateway.cli.main import main


def typed_here(arguments: Sequence[object]) -> tuple[int, str, str]:
    """Exit code, output and errors, this thread's warnings among the errors."""
    output, errors = io.StringIO(), io.StringIO()
    warnings = logging.StreamHandler(errors)
    warnings.setLevel(logging.WARNING)
    own = threading.get_ident()
    warnings.addFilter(lambda record: record.thread == own)  # there may be a suit in this process, too
    logging.getLogger().addHandler(warnings)
    try:
        with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(output):
            patch.setattr(sys, "argv", ["mocap-gateway", *map(str, arguments)])
            with contextlib.redirect_stderr(errors), pytest.raises(SystemExit) as left:
                main()
    finally:
        logging.getLogger().removeHandler(warnings)
    code = left.value.code
    assert isinstance(code, int | None)
    return code or 0, output.getvalue(), errors.getvalue()
