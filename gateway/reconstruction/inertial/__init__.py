"""Inertial reconstruction: ``articulated`` (the source's method, literally), ``independent`` (by module),
``joint`` and ``outward`` (the estimators)."""
