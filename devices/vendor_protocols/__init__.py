"""What modules of other makers say on the wire: bytes to values and back. Never raises for bytes; no I/O."""
