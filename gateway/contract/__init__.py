"""What programs outside may count on: topics, messages, requests, balances, as models.

Everything that speaks with them imports these; they import nothing but the body. ``documents`` makes the
JSON Schemas, the AsyncAPI description and the reference page of them.
"""
