"""What modules of other makers say on the wire: bytes to values and back. Never raises for bytes; no I/O.

A maker a file, for gateway and emulator alike: ``gateway/sources`` makes samples of the values,
``devices/emulators/makers`` sends them. ``plausibility`` is for protocols that check little of what they
carry, ``rotations`` for those that write turns in their own way. Values are in the maker's units unless a
field names another.
"""
