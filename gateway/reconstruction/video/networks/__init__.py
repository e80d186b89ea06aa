"""Pose networks: one picture of one person to heat maps."""

from gateway.reconstruction.video.networks.network import PoseNetwork, load_network
from gateway.reconstruction.video.networks.weights import NETWORKS

__all__ = ["NETWORKS", "PoseNetwork", "load_network"]
