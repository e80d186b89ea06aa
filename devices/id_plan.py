"""In which order module ids are changed so that no two devices share one on the way. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from typing import NamedTuple

from firmware_protocol import MAX_MODULE


class Move(NamedTuple):
    """One device takes another id."""

    unique_id: bytes
    before: int
    after: int


def plan_moves(
    present: Mapping[bytes, int],
    wanted: Mapping[bytes, int],
    reserved: Collection[int] = (),
    *,
    may_share: bool = False,
) -> list[Move]:
    """Return the changes that lead from the present ids to the wanted ones, in a safe order.

    present: id of every device that can be heard; wanted: id of those that are to have a certain one.
    A device takes an id only when nobody has it. Where ids go round in a circle one device waits on a
    spare id, if there is one that is neither present, wanted nor reserved. Without a spare, and only
    then, two devices share an id for the time of one change.

    may_share: ids that several devices have at the end are wanted, to take a separation of them back.
    Raises ``ValueError`` otherwise for an id that is wanted twice, or held by a device that is to keep it.
    """
    if not may_share:
        _refuse_impossible(present, wanted)
    held = dict(present)
    pending = {uid: wanted[uid] for uid in sorted(wanted) if held.get(uid, wanted[uid]) != wanted[uid]}
    moves: list[Move] = []
    while pending:
        # Where ids may be shared at the end, those of devices that have theirs block nobody.
        settled = {held[each] for each in held if each not in pending} if may_share else set()
        uid, after = _next_change(pending, held, {*wanted.values(), *reserved}, settled)
        moves.append(Move(uid, held[uid], after))
        held[uid] = after
        if pending[uid] == after:
            del pending[uid]
    return moves


def spare_id(taken: Collection[int]) -> int | None:
    """Return the highest id that is not taken: the rigs people write count from below."""
    return next((spare for spare in range(MAX_MODULE, -1, -1) if spare not in taken), None)


def _next_change(
    pending: Mapping[bytes, int],
    held: Mapping[bytes, int],
    reserved: set[int],
    shared: Collection[int],
) -> tuple[bytes, int]:
    """Return who takes which id next. shared: ids that are taken although somebody has and keeps them."""
    taken = set(held.values())
    for uid, after in pending.items():
        if after not in taken or after in shared:
            return uid, after
    # Ids go round in a circle. Who waits on a spare one already stands in nobody's way: moved from spare to
    # spare, it would be for ever.
    awaited = set(pending.values())
    uid = next(each for each in pending if held[each] in awaited)
    spare = spare_id(reserved | taken)
    return uid, pending[uid] if spare is None else spare


def _refuse_impossible(present: Mapping[bytes, int], wanted: Mapping[bytes, int]) -> None:
    twice = [each for each, n in Counter(wanted.values()).items() if n > 1]
    if twice:
        raise ValueError(f"module id {twice[0]} is wanted for more than one device")
    for uid, held in present.items():
        if uid not in wanted and held in wanted.values():
            raise ValueError(f"module id {held} is held by device {uid.hex()}: give that one another id too")
