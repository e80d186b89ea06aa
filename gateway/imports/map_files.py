"""Maps of modules to segments: YAML, or the XML that OpenSense takes."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import parse

from gateway.errors import GatewayError
from gateway.support.settings_files import load_yaml


def read_maps(texts: list[str]) -> dict[str, str]:
    """``--map`` options together: ``NAME=SEGMENT`` or a file. Raises ``GatewayError``."""
    given: dict[str, str] = {}
    for text in texts:
        name, equals, segment = text.rpartition("=")
        if equals and name and segment:
            given[name] = segment
        else:
            given.update(_of_file(Path(text)))
    return given


def _of_file(path: Path) -> dict[str, str]:
    if path.suffix.lower() == ".xml":
        return _of_opensense(path)
    content = load_yaml(path)
    if not isinstance(content, dict) or not all(isinstance(value, str) for value in content.values()):
        raise GatewayError(f"{path}: lines 'module: segment' are wanted, such as '00B42279: pelvis'")
    return {str(name): segment for name, segment in content.items()}


def _of_opensense(path: Path) -> dict[str, str]:
    """``<ExperimentalSensor name="_00B42279">`` with its ``<name_in_model>``."""
    try:
        sensors = list(parse(path, forbid_dtd=True).iter("ExperimentalSensor"))
    except (ParseError, DefusedXmlException) as error:
        raise GatewayError(f"{path}: no XML that can be read ({error})") from error
    except OSError as error:
        raise GatewayError(f"{path} cannot be read: {error.strerror}") from error
    if not sensors:
        raise GatewayError(f"{path} names no <ExperimentalSensor>: a mapping file of OpenSense is wanted")
    return {str(each.get("name")): each.findtext("name_in_model", "").strip() for each in sensors}
