"""Pose networks: one picture of one person to heat maps."""

from gateway.reconstruction.video.networks.network import PoseNetwork
from gateway.reconstruction.video.networks.weights import NETWORKS, load_network

__all__ = ["NETWORKS", "PoseNetwork", "load_network"]
