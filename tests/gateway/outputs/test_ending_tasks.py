"""Tasks end even when a cancellation is turned into something else on its way."""

import asyncio

from gateway.outputs.connection import end_tasks
from tests.patience import PATIENCE_S


async def test_a_task_that_loses_its_first_cancellation_is_cancelled_again():
    cancellations = 0

    async def reconnect_for_ever() -> None:
        nonlocal cancellations
        while True:
            try:
                await asyncio.sleep(60)
            except asyncio.CancelledError:
                cancellations += 1
                if cancellations > 1:
                    raise

    task = asyncio.create_task(reconnect_for_ever())
    await asyncio.sleep(0.01)
    async with asyncio.timeout(PATIENCE_S):
        await end_tasks(task)
    assert task.cancelled()
    assert cancellations == 2
