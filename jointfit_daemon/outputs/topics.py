"""The MQTT topics of the daemon: names, quality of service, and retained flags.

Invariant: the table of topics in docs/mqtt.md equals `TOPICS`.
"""

from __future__ import annotations

from dataclasses import dataclass

PAYLOAD_VERSION = 1
"""Version of all payloads. It is incremented when a key is removed or renamed, or changes its
meaning."""

ONLINE, OFFLINE = b'{"v":1,"state":"online"}', b'{"v":1,"state":"offline"}'
"""Payloads of `BRIDGE_STATE` and `DEVICE_AVAILABILITY`."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic relative to the base topic of a rig."""

    pattern: str
    """Name relative to the base topic. A level in capitals is a placeholder."""
    qos: int
    """Quality of service: messages with 1 are acknowledged, messages with 0 are not."""
    retained: bool = False
    """Whether the broker stores the last message for later subscribers."""

    def name(self, base: str, value: str = "") -> str:
        """Return the full topic name, with `value` in place of the placeholder."""
        levels = [value if level.isupper() else level for level in self.pattern.split("/")]
        return "/".join([base, *levels])


BRIDGE_STATE = Topic("bridge/state", 1, retained=True)
BRIDGE_INFO = Topic("bridge/info", 1, retained=True)
BRIDGE_HEALTH = Topic("bridge/health", 1, retained=True)
BRIDGE_EVENT = Topic("bridge/event", 1)
BRIDGE_LOG = Topic("bridge/log", 0)
REQUEST = Topic("bridge/request/COMMAND", 1)
RESPONSE = Topic("bridge/response/COMMAND", 1)
CALIBRATION = Topic("calibration", 1, retained=True)
CALIBRATION_PROGRESS = Topic("calibration/progress", 0)
DEVICE_AVAILABILITY = Topic("device/ID/availability", 1, retained=True)
DEVICE_INFO = Topic("device/ID/info", 1, retained=True)
POSE = Topic("pose", 0)
POSE_UI = Topic("pose/ui", 0)
OPTICAL_POSE = Topic("optical/pose", 0)
OPTICAL_CHAIN = Topic("optical/chain", 0)
SENSORS_POSE = Topic("sensors/pose", 0)
OPTICAL_CENTERS = Topic("optical/centers", 0)
OPTICAL_STICKS = Topic("optical/sticks", 0)
JOINT = Topic("joint/NAME", 0)
LATE_EVENT = Topic("late/event", 1)
LATE_POSE = Topic("late/pose", 1)

TOPICS = (
    BRIDGE_STATE, BRIDGE_INFO, BRIDGE_HEALTH, BRIDGE_EVENT, BRIDGE_LOG, REQUEST, RESPONSE,
    CALIBRATION, CALIBRATION_PROGRESS, DEVICE_AVAILABILITY, DEVICE_INFO, POSE, POSE_UI,
    OPTICAL_POSE, OPTICAL_CHAIN, SENSORS_POSE, OPTICAL_CENTERS, OPTICAL_STICKS, JOINT,
    LATE_EVENT, LATE_POSE,
)  # fmt: skip
"""All topics, in the order of docs/mqtt.md."""


def client_identifier(base: str) -> str:
    """Return the daemon's client id on the broker, which is also its device id in Home Assistant.

    The id is fixed, so that a new process takes over the connection of a terminated process. It
    contains only letters, digits and dashes, because the broker rumqttd fails on a slash.
    """
    return "jointfitd-" + "".join(
        letter if letter.isascii() and letter.isalnum() else "-" for letter in base
    )
