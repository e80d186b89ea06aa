"""Reconstructors by name: observations in time order to skeleton frames.

What needs the names alone (the configuration, the command line) imports no method: each is imported when one
of it is made.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from devices.deferred import Deferred
from gateway.errors import SettingsError, nearest
from gateway.frames import Quantity
from gateway.reconstruction.reconstructor import Reconstructor, update_many
from gateway.reconstruction.root_settings import NO_CONTACTS, RootMode, RootSettings

if TYPE_CHECKING:
    from gateway.body.skeleton import WornSuit
    from gateway.reconstruction.whole_body import OrientationFinder

__all__ = [
    "BOTH_WAYS",
    "DELAYABLE",
    "DELAYS_IN_NAMES",
    "FUSED",
    "NO_CONTACTS",
    "OFFLINE",
    "OPTICAL",
    "PUBLISHED",
    "RECONSTRUCTORS",
    "Reconstructor",
    "RootMode",
    "RootSettings",
    "create_reconstructor",
    "refuse_delay",
    "refuse_unknown",
    "refuse_unreadable",
    "update_many",
]

_FUSED = Deferred("gateway.reconstruction.fused", "FusedReconstructor")

RECONSTRUCTORS: dict[str, Callable[..., OrientationFinder]] = {
    "articulated": Deferred("gateway.reconstruction.inertial.articulated", "ArticulatedReconstructor"),
    "fused": _FUSED,
    "fused_neutral": partial(_FUSED, starts_neutral=True),
    "gyro_free": Deferred("gateway.reconstruction.inertial.rate_free", "RateFreeReconstructor"),
    "independent": Deferred("gateway.reconstruction.inertial.independent", "IndependentReconstructor"),
    "joint": Deferred("gateway.reconstruction.inertial.tree.reconstructor", "JointReconstructor"),
    "outward": Deferred("gateway.reconstruction.inertial.tree.reconstructor", "OutwardReconstructor"),
}
"""Name to constructor; its arguments: the suit, and the nominal interval of the frames in s. Those of
``DELAYABLE`` take a third, ``delay_s``."""

DELAYABLE = frozenset({"gyro_free"})
"""Those whose frames may come later and better: corrected by what was seen meanwhile."""

DELAYS_IN_NAMES = {"gyro_free_delayed": 0.5, "gyro_free_delayed_100ms": 0.1, "gyro_free_delayed_200ms": 0.2}
"""Former names of ``gyro_free`` with a delay (s), which older recordings still have."""

OPTICAL = "optical"
"""Of markers and no modules: ``optical.reconstructor``; it needs a suit with markers."""

PUBLISHED = "published"
"""Of markers too, but of all frames at once: for `optical solve`, never for a stream."""

BOTH_WAYS = "both_ways"
"""As ``OPTICAL``, with gaps bridged from both sides: of all frames at once too."""

OFFLINE = (PUBLISHED, BOTH_WAYS)
"""Methods that no stream can have."""

FUSED = frozenset({"fused", "fused_neutral"})
"""Those that want orientations fused on the modules, and no raw values."""


SEES_SUN = frozenset({"articulated", "independent", "joint", "outward"})
"""Those that take the sun for their second field; beside the magnetometers only the chain filters do."""

CHAINS = frozenset({"joint", "outward"})


def refuse_unreadable(name: str, suit: WornSuit) -> None:
    """Raise ``SettingsError`` where the suit has a sensor that the reconstructor of that name cannot use."""
    if suit.sun is not None:
        can = CHAINS if suit.sun.beside_magnetometer else SEES_SUN
        word = "both" if suit.sun.beside_magnetometer else "sun"
        if name not in can:
            known = ", ".join(sorted(can))
            raise SettingsError(
                f"reconstructor '{name}' cannot use the rig's 'second_field: {word}'; these can: {known}"
            )
    if name == "articulated" and any(d.quantity is Quantity.AIR_VELOCITY for d in suit.local_devices[:1]):
        raise SettingsError(
            "reconstructor 'articulated' cannot use pressure tubes; these can: joint, outward"
        )


def refuse_unknown(name: str, *others: str) -> None:
    """Raise ``ValueError`` for a name that neither a method nor one of the others has."""
    if name in DELAYS_IN_NAMES:
        delay = f"{DELAYS_IN_NAMES[name] * 1e3:g}"
        raise ValueError(
            "no such reconstructor any more: write 'reconstructor: gyro_free' and 'reconstructor_delay_ms: "
            f"{delay}', on the command line --reconstructor gyro_free --delay-ms {delay}"
        )
    if name not in RECONSTRUCTORS and name not in others:
        raise ValueError("no such reconstructor" + nearest(name, [*RECONSTRUCTORS, *others]))


def refuse_delay(name: str, delay_s: float) -> None:
    """Raise ``ValueError`` where a delay is asked of a method that has none."""
    if delay_s and name not in DELAYABLE:
        can = ", ".join(sorted(DELAYABLE))
        raise ValueError(f"reconstructor '{name}' gives its frames at once: a delay is for {can}")


def create_reconstructor(
    name: str,
    suit: WornSuit,
    nominal_interval_s: float,
    root: RootSettings | None = None,
    delay_s: float = 0.0,
) -> Reconstructor:
    """Return the reconstructor of that name; for the whole body, unless modules give fused orientations.

    delay_s: by which its frames come later, corrected by what was seen meanwhile.

    Raises ``ValueError`` for an unknown one, naming those there are, for a delay that it cannot have, and for
    a root that shall walk on a body without contacts; ``SettingsError`` where the suit has a sensor that this
    method cannot use."""
    if name not in RECONSTRUCTORS:
        known = ", ".join(sorted(RECONSTRUCTORS))
        raise ValueError(f"no reconstructor is called {name!r}; there are: {known}")
    refuse_unreadable(name, suit)
    refuse_delay(name, delay_s)
    delay = {"delay_s": delay_s} if delay_s else {}
    finder = RECONSTRUCTORS[name](suit, nominal_interval_s, **delay)
    if name in FUSED:
        return finder
    from gateway.reconstruction.whole_body import WholeBodyReconstructor  # noqa: PLC0415 - see above

    return WholeBodyReconstructor(suit, finder, root)
