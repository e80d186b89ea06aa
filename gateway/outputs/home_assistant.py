"""Discovery messages for Home Assistant: how modules fare. Poses are nothing for a home's data base."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import orjson

from gateway.contract.messages import BridgeInfo
from gateway.contract.topics import Topics

_SENSORS: dict[str, dict[str, Any]] = {
    "battery": {
        "name": "Battery",
        "device_class": "battery",
        "unit_of_measurement": "%",
        "value_template": "{{ value_json.battery_percent }}",
    },
    "loss": {
        "name": "Packets lost",
        "icon": "mdi:access-point-network-off",
        "unit_of_measurement": "%",
        "value_template": "{{ (100 * value_json.lost / ([value_json.lost + value_json.received, 1] | max)) "
        "| round(2) }}",
    },
    "clock": {
        "name": "Clock rate",
        "icon": "mdi:clock-outline",
        "unit_of_measurement": "ppm",
        "value_template": "{{ value_json.clock.ppm if value_json.clock else None }}",
    },
}


def discovery(prefix: str, topics: Topics, info: BridgeInfo) -> Iterator[tuple[str, bytes]]:
    """Return (topic, payload) to be retained: for the gateway, and for each module of its rig."""
    node = f"mocap_{info.gateway}"
    gateway = {
        "identifiers": [node],
        "name": f"Motion capture {info.gateway}",
        "sw_version": info.version,
    }
    running = {
        "name": "Running",
        "unique_id": f"{node}_running",
        "device_class": "running",
        "state_topic": topics.bridge_state,
        **_on_while_online(),
        "device": gateway,
    }
    yield f"{prefix}/binary_sensor/{node}/running/config", orjson.dumps(running)
    for module in info.modules:
        name = f"module_{module.module}"
        device = {
            "identifiers": [f"{node}_{name}"],
            "name": f"{info.gateway} module {module.module} ({module.segment})",
            "via_device": node,
        }
        connectivity = {
            "name": "Heard",
            "unique_id": f"{node}_{name}_heard",
            "device_class": "connectivity",
            "entity_category": "diagnostic",
            "state_topic": topics.module_availability(module.module),
            **_on_while_online(),
            "availability": [_available_by(topics.bridge_state)],
            "device": device,
        }
        yield f"{prefix}/binary_sensor/{node}/{name}_heard/config", orjson.dumps(connectivity)
        for key, sensor in _SENSORS.items():
            config = {
                **sensor,
                "unique_id": f"{node}_{name}_{key}",
                "entity_category": "diagnostic",
                "state_class": "measurement",
                "state_topic": topics.module_state(module.module),
                "availability_mode": "all",
                "availability": [
                    _available_by(topics.bridge_state),
                    _available_by(topics.module_availability(module.module)),
                ],
                "device": device,
            }
            yield f"{prefix}/sensor/{node}/{name}_{key}/config", orjson.dumps(config)


def _on_while_online() -> dict[str, str]:
    return {"value_template": "{{ value_json.state }}", "payload_on": "online", "payload_off": "offline"}


def _available_by(topic: str) -> dict[str, str]:
    return {"topic": topic, "value_template": "{{ value_json.state }}"}
