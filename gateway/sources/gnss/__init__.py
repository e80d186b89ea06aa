"""Satellite positioning as a local measuring device: bytes of a receiver to readings in the local world."""
