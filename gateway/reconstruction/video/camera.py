"""Cameras as the reconstructor takes them: see ``gateway.body.camera``, where suits can name them too."""

from gateway.body.camera import Camera, project

__all__ = ["Camera", "project"]
