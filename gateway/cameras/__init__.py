"""Synchronised cameras of this machine: a process for each, from pictures to heat maps."""
