"""Readings of many modules, markers or cameras to one instant: frames."""
