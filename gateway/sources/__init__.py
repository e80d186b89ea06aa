"""Bytes of links to readings in gateway time: the suit's stream, satellites, light, air, hips.

``stream`` is the suit: framing, packets, clocks.
"""
