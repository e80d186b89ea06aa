"""Satellite positioning as a local measuring device: bytes of a receiver to readings in the local world."""

from __future__ import annotations

from devices.geodesy import LocalPlane, geodetic
from gateway.sources.gnss.receiver import GnssParams, GnssReceiver
from gateway.sources.gnss.sentences import Fix, GnssDecoder, GnssDefect

__all__ = ["Fix", "GnssDecoder", "GnssDefect", "GnssParams", "GnssReceiver", "LocalPlane", "geodetic"]
