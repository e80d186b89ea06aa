"""Recorded poses in the files that other programs open; one format a file.

``take`` makes what all formats share: a motion at a regular rate without holes, in the world axes and
the length unit that were asked for. ``FORMATS`` names the formats.
"""

from gateway.recording.exporters.formats import FORMATS, Format
from gateway.recording.exporters.take import Axes, Take, take_of

__all__ = ["FORMATS", "Axes", "Format", "Take", "take_of"]
