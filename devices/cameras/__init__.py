"""Cameras: pictures from files, folders and devices, and heat maps from cameras elsewhere."""
