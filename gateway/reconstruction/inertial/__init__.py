"""Inertial reconstruction: ``articulated`` (the source's method, literally) and ``independent`` (module by module)."""
