"""mocap-gateway: a wearable inertial suit in, a skeleton over MQTT out.

Reading order: ``pipeline`` (the flow as code), ``frames`` (every value that flows), ``stream`` and
``clocks`` (bytes to readings in gateway time), ``assembly`` (readings to frames of one instant),
``reconstruction`` (frames to segment orientations), ``outputs`` (MQTT), ``service`` (all of it with
links and a broker), ``cli`` (one file a subcommand).
"""

from gateway.support.processor import settle

settle()  # before any module imports NumPy


def __getattr__(name: str) -> str:
    """Return ``__version__``, looked up when it is asked for: that takes long, and help needs it not."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 - see above

    try:
        return version("mocap-gateway")
    except PackageNotFoundError:  # run from the source tree, without an installation
        return "0.1.0"
