"""mocap-gateway: a wearable inertial suit in, a skeleton over MQTT out.

Reading order: ``pipeline`` (the flow as code), ``frames`` (every value that flows), ``stream`` and
``clocks`` (bytes to readings in gateway time), ``assembly`` (readings to frames of one instant),
``reconstruction`` (frames to segment orientations), ``outputs`` (MQTT), ``service`` (all of it with
links and a broker), ``cli`` (one file a subcommand).
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("mocap-gateway")
except PackageNotFoundError:  # run from the source tree, without an installation
    __version__ = "0.1.0"
