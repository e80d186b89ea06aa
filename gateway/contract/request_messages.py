"""Requests and their responses over MQTT, as models."""

from __future__ import annotations

from typing import Annotated, Literal

import orjson
from pydantic import Field, JsonValue

from gateway.contract.messages import Message

LARGEST_REQUEST = 64 * 1024
"""Bytes; longer ones are refused unread."""

LONGEST_TRANSACTION = 64

Transaction = Annotated[str, Field(max_length=LONGEST_TRANSACTION)] | int | None


class ResponseMessage(Message):
    """What became of a request."""

    status: Literal["ok", "error"]
    data: dict[str, JsonValue] = Field(default_factory=dict, description="What was asked for.")
    error: str | None = Field(default=None, description="What was found, and what would do.")
    transaction: Transaction = Field(default=None, description="That of the request.")


class RequestProblem(ValueError):
    """A payload that is no request; nothing can be told of its transaction."""


def parse_request(payload: object) -> tuple[dict[str, JsonValue], Transaction]:
    """Return data and transaction of a request: a JSON object, or nothing at all. Raises
    ``RequestProblem``."""
    if not isinstance(payload, bytes | bytearray):
        payload = b""
    # Before parsing: the size of what anybody may send must be bounded first.
    if len(payload) > LARGEST_REQUEST:
        raise RequestProblem(f"a request of {len(payload)} bytes: at most {LARGEST_REQUEST} are taken")
    if not payload.strip():
        return {}, None
    try:
        request = orjson.loads(payload)
    except ValueError:
        raise RequestProblem('a request is a JSON object, such as {"transaction": 1}') from None
    if not isinstance(request, dict):
        raise RequestProblem('a request is a JSON object, such as {"transaction": 1}')
    transaction = request.pop("transaction", None)
    is_text = isinstance(transaction, str) and len(transaction) <= LONGEST_TRANSACTION
    # In Python True is an integer, in JSON it is not.
    is_number = isinstance(transaction, int) and not isinstance(transaction, bool)
    if not (transaction is None or is_text or is_number):
        raise RequestProblem(f"'transaction' is a number or a text of up to {LONGEST_TRANSACTION} characters")
    return request, transaction
