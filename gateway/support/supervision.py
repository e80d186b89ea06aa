"""Tasks beside the stream that must not end unnoticed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from devices.back_off import BackOff

log = logging.getLogger(__name__)

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0


async def kept_running(name: str, run: Callable[[], Awaitable[None]]) -> None:
    """Run something for ever: when it fails, say so with its traceback and run it again after a pause.

    The pause doubles with every failure, up to half a minute. Returning is an orderly end.
    """
    back_off = BackOff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
    while True:
        try:
            await run()
        # Whatever it is: the gateway lives for days, and one part must not end the others.
        except Exception:
            pause_s = back_off.next_delay()
            log.exception("%s failed; it is started again in %g s", name, pause_s)
        else:
            return
        await asyncio.sleep(pause_s)
