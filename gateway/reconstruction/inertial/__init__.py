"""Inertial reconstruction: ``articulated`` (the source's method, literally), ``independent`` (by module)."""
