"""The rig file of a running gateway: what calibrations and the wearer's measures are kept in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gateway.body.anthropometry import Subject, scaled
from gateway.body.body_file import load_body
from gateway.body.rig import RigFile
from gateway.body.skeleton import Skeleton
from gateway.calibration.mounting import keep, worn_rig
from gateway.calibration.rig_file import write_rig
from gateway.support import yaml_text
from gateway.support.settings_files import find_file, load_settings, load_yaml
from gateway.support.whole_files import write_whole, writing


@dataclass(frozen=True)
class KeptRig:
    """Which file that is, and how the configuration comes to name it."""

    rig: str
    """As the configuration names it: a file, or a shipped one, which is never written to."""
    config: Path | None = None
    """The configuration file; None: there is none, and what is written is used in this run alone."""

    @property
    def configured(self) -> Path:
        """The file that the configuration means. Raises ``SettingsError`` when it is gone."""
        return find_file(self.rig, "rigs", self.config)

    @property
    def target(self) -> Path:
        """The file that is written: the configured one, or beside the configuration for a shipped one.

        Raises ``SettingsError`` when the configured one is gone.
        """
        path = worn_rig(self.configured)
        is_shipped = path != self.configured
        return self.config.parent / path if is_shipped and self.config is not None else path

    @property
    def source(self) -> Path:
        """The file that the new one is made from: what was written last, else the configured one."""
        return self.target if self.target.is_file() else self.configured

    def name_in_configuration(self) -> bool:
        """Have the configuration name the written file, so that the next start uses it.

        Returns whether it does: not without a configuration file, nor where that names another rig
        meanwhile. Comments and all other settings stay. Raises ``GatewayError`` when the file cannot be
        written.
        """
        target = self.target
        if target.resolve() == self.configured.resolve():
            return True
        # Somebody changed the configuration by hand meanwhile: that counts more than this.
        if self.config is None or load_yaml(self.config).get("rig") != self.rig:
            return False
        name = name_for(self.config, target)
        text = self.config.read_text(encoding="utf-8")
        with writing(self.config):
            write_whole(self.config, yaml_text.replaced(text, ("rig",), name).encode("utf-8"))
        return True

    def subject(self) -> Subject:
        """Return the wearer's measures as they are kept. Raises ``SettingsError`` for a bad rig file."""
        return load_settings(self.source, RigFile).subject or Subject()

    def keep_subject(self, changes: Mapping[str, Any]) -> tuple[Subject, Skeleton]:
        """Write the wearer's measures into the rig file, and return them with the body that they make.

        changes: settings of ``Subject``; what they leave out stays, a length of None is forgotten. The
        earlier file goes to the history. Raises ``GatewayError`` for measures that the body does not have,
        and when the file cannot be written.
        """
        source, target = self.source, self.target
        rig = load_settings(source, RigFile)
        before = (rig.subject or Subject()).model_dump(exclude_none=True)
        lengths = {**before.get("lengths", {}), **changes.get("lengths", {})}
        known = {name: length for name, length in lengths.items() if length is not None}
        subject = Subject.model_validate({**before, **changes, "lengths": known})
        body = scaled(load_body(rig.body, source, rig.joint_definitions), subject, "the wearer")
        content: dict[str, Any] = load_yaml(source)
        content["subject"] = subject.as_json()
        now = datetime.now(UTC)
        keep(target, now)
        head = f"# {source.name}, worn by somebody who was measured {now:%Y-%m-%d %H:%M} UTC.\n"
        write_rig(source, target, content, lambda _module: None, head)
        return subject, body


def name_for(config: Path, rig: Path) -> str:
    """Return how a configuration file names a rig file wherever the gateway is started: without a folder
    beside it, which still holds when the whole folder is moved."""
    is_beside = rig.parent.resolve() == config.parent.resolve()
    return rig.name if is_beside else str(rig.resolve())


def rig_advice(rig: Path, config: Path | None) -> str:
    """Return what to say after a rig file was written; config: where it is to be used, if that is known."""
    name = str(rig) if config is None else name_for(config, rig)
    return f"written to {rig}: use it as 'rig: {name}'"


def measured(
    height_m: float | None, mass_kg: float | None, lengths: Mapping[str, float | None]
) -> dict[str, Any]:
    """Return the changes that these measures make: none for what is None, or not given."""
    fields = {"height_m": height_m, "mass_kg": mass_kg, "lengths": dict(lengths) or None}
    return {name: value for name, value in fields.items() if value is not None}
