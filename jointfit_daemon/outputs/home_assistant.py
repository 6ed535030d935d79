"""Device discovery by Home Assistant: one retained message describes the rig and its entities.

Invariant: every entity reads a topic of docs/mqtt.md with at most one message per second. The
format is described in Home Assistant's documentation of MQTT discovery, "device discovery payload".
"""

from __future__ import annotations

import json
from math import ceil
from typing import TYPE_CHECKING, Any

from jointfit_daemon import __version__
from jointfit_daemon.limb_model import angle_convention, inner_joints
from jointfit_daemon.model import ANGLE_NAMES
from jointfit_daemon.outputs import topics
from jointfit_daemon.pipeline.events import CalibrationPhase

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.config import MqttSettings, Rig

_SILENCE_MESSAGES = 5
"""Number of missing messages after which Home Assistant shows an angle as unavailable."""
_BUTTONS = {
    "static": ("Static pose", "static", {}, "mdi:human-handsup"),
    "calibrate": ("Calibrate by movement", "calibrate", {"phase": "functional"}, "mdi:run"),
    "abort": ("Abort calibration", "calibrate", {"phase": "abort"}, "mdi:stop"),
}
"""Name, request, arguments of the request, and icon of each button."""


def discovery_topic(settings: MqttSettings) -> str | None:
    """Return the topic of the discovery message; None without ``[mqtt.home_assistant]``."""
    if settings.home_assistant is None:
        return None
    name = topics.client_identifier(settings.base)
    return f"{settings.home_assistant.prefix}/device/{name}/config"


def discovery_payload(rig: Rig) -> dict[str, Any]:
    """Return the content of the discovery message.

    Buttons exist only if the rig can be calibrated and requests need no signature, because Home
    Assistant cannot sign requests. A planar rig is not calibrated.

    Parameters
    ----------
    rig
        Rig whose joints, sensors, topics and rates the message describes.
    """
    base, device = rig.mqtt.base, topics.client_identifier(rig.mqtt.base)
    components = dict([*_angles(rig), *_calibration(base), *_problems(rig)])
    if rig.mqtt.request_key_file is None and not rig.chain.planar:
        components |= {
            f"{key}_button": {
                "platform": "button",
                "name": name,
                "command_topic": topics.REQUEST.name(base, request),
                "payload_press": json.dumps(arguments),
                "qos": 1,
                "icon": icon,
            }
            for key, (name, request, arguments, icon) in _BUTTONS.items()
        }
    for key, component in components.items():
        component["unique_id"] = f"{device}_{key}"
    return {
        "device": {
            "identifiers": [device],
            "name": rig.name,
            "manufacturer": "jointfitd",
            "model": ", ".join(rig.chain.segments),
            "sw_version": __version__,
        },
        "origin": {"name": "jointfitd", "sw_version": __version__},
        "availability_topic": topics.BRIDGE_STATE.name(base),
        "availability_template": "{{ value_json.state }}",
        "components": components,
    }


def _angles(rig: Rig) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield entities for the angles of each joint between two segments, and for their sd."""
    if rig.chain.planar:  # A planar chain is published as optical/sticks, without angles.
        return
    for joint in inner_joints(rig.chain):
        names = ANGLE_NAMES[angle_convention(rig.chain, joint.number)]
        topic = topics.JOINT.name(rig.mqtt.base, joint.name)
        for name in (*names, "sd"):
            title = "standard deviation" if name == "sd" else name
            yield (
                f"{joint.name}_{name}",
                {
                    "platform": "sensor",
                    "name": f"{joint.name} {title}".capitalize(),
                    "state_topic": topic,
                    "value_template": f"{{{{ value_json.{name}_deg }}}}",
                    "unit_of_measurement": "°",
                    "state_class": "measurement",
                    "suggested_display_precision": 1,
                    "expire_after": ceil(_SILENCE_MESSAGES / rig.mqtt.joint_hz),
                    "icon": "mdi:plus-minus" if name == "sd" else "mdi:angle-acute",
                }
                | ({"entity_category": "diagnostic"} if name == "sd" else {}),
            )


def _calibration(base: str) -> Iterator[tuple[str, dict[str, Any]]]:
    topic = topics.CALIBRATION.name(base)
    yield (
        "calibration_phase",
        {
            "platform": "sensor",
            "name": "Calibration",
            "state_topic": topic,
            "value_template": "{{ value_json.phase }}",
            "device_class": "enum",
            "options": [str(phase) for phase in CalibrationPhase],
            "json_attributes_topic": topic,
            "json_attributes_template": '{{ {"text": value_json.text} | tojson }}',
            "icon": "mdi:tune",
        },
    )
    yield (
        "calibration_version",
        {
            "platform": "sensor",
            "name": "Calibration version",
            "state_topic": topic,
            "value_template": "{{ value_json.version }}",
            "entity_category": "diagnostic",
            "icon": "mdi:counter",
        },
    )


def _problems(rig: Rig) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield a binary sensor of class ``problem`` for each device.

    The binary sensor is on if the device is disconnected, silent or stuck.
    """
    for source in rig.sources:
        device = f"value_json.devices[{json.dumps(source.id)}]"  # escaped as in Jinja templates
        yield (
            f"device_{source.id}_problem",
            {
                "platform": "binary_sensor",
                "name": f"{source.id} problem",
                "device_class": "problem",
                "entity_category": "diagnostic",
                "state_topic": topics.BRIDGE_HEALTH.name(rig.mqtt.base),
                "value_template": (
                    f"{{{{ 'OFF' if {device}.online and "
                    f"{device}.sensor | default('ok') == 'ok' else 'ON' }}}}"
                ),
            },
        )
