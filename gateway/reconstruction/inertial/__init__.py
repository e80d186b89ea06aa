"""Inertial reconstruction, a method or two a file.

tree/                      ``joint`` and ``outward``, the estimators: docs/explanation/estimator.md
independent, module_filter every module for itself
articulated, operators     the source's method, literally
rate_free, rate_free_filter  ``gyro_free``: no gyroscopes
contacts                   which segments stand, and where the body is because of it
observations, local_devices, travel  what several of them begin with
"""
