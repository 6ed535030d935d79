"""Writer that publishes the outputs of the core on the MQTT topics, through the outbox.

Invariant: no method waits for a broker. docs/mqtt.md describes topics, rates and retained flags.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import orjson

from jointfit_daemon import __version__
from jointfit_daemon.limb_model import (
    angle_convention,
    body_parts,
    inner_joints,
    is_left,
    joint_parts,
)
from jointfit_daemon.model import (
    ChainModelState,
    LimbState,
    OpticalState,
    RunningCenters,
    SensorStates,
    StickFigure,
)
from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.home_assistant import discovery_payload, discovery_topic
from jointfit_daemon.outputs.log import printable, printable_data
from jointfit_daemon.outputs.payloads._encoding import (
    encode,
    encode_centers,
    encode_chain,
    encode_joint,
    encode_optical,
    encode_pose,
    encode_sensors,
    encode_sticks,
)
from jointfit_daemon.outputs.payloads._health_encoding import health_payload
from jointfit_daemon.outputs.payloads._quality_units import quality_payload
from jointfit_daemon.outputs.topics import OFFLINE, ONLINE, PAYLOAD_VERSION
from jointfit_daemon.pipeline.events import (
    CalibrationProgress,
    CalibrationStatus,
    DeviceInfo,
    DeviceStatus,
    Notice,
    NoticeKind,
    Reply,
)
from jointfit_daemon.timing.alignment import RateDivider

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.config import Rig
    from jointfit_daemon.model import Chain
    from jointfit_daemon.outputs.frame_latency import FrameLatency
    from jointfit_daemon.outputs.mqtt import Outbox
    from jointfit_daemon.outputs.payloads._health_encoding import BridgeHealth
    from jointfit_daemon.outputs.spool import Spool
    from jointfit_daemon.outputs.topics import Topic
    from jointfit_daemon.outputs.unix_clock import UnixClock
    from jointfit_daemon.pipeline.events import Event, Output

_STREAMS: dict[type, tuple[Topic, Callable[[Any, int], bytes]]] = {
    OpticalState: (topics.OPTICAL_POSE, encode_optical),
    ChainModelState: (topics.OPTICAL_CHAIN, encode_chain),
    SensorStates: (topics.SENSORS_POSE, encode_sensors),
    RunningCenters: (topics.OPTICAL_CENTERS, encode_centers),
    StickFigure: (topics.OPTICAL_STICKS, encode_sticks),
}
"""Topic and encoder of each output whose payload contains its own time."""


class TopicWriter:
    """Writes the topics of one rig into an outbox; a `Sink` of the core.

    Parameters
    ----------
    rig
        Rig that defines names, base topic and rates.
    outbox
        Outbox to which the messages are added.
    clock
        Clock that converts stamps to UNIX time.
    spool
        Spool that stores events and decimated poses during an outage; None without a spool.
    latency
        Object that measures the encoding and writing of every frame.
    """

    def __init__(
        self,
        rig: Rig,
        outbox: Outbox,
        clock: UnixClock,
        spool: Spool | None = None,
        latency: FrameLatency | None = None,
    ) -> None:
        self._base, self._outbox, self._clock = rig.mqtt.base, outbox, clock
        self._spool, self._latency = spool, latency
        self._pose_topic = topics.POSE.name(self._base)
        self._pose_ui_topic = topics.POSE_UI.name(self._base)
        self._devices: tuple[str, ...] = ()
        self._discovery: str | None = None
        self._components: dict[str, Any] = {}
        self.configure(rig)

    def configure(self, rig: Rig) -> None:
        """Publish the configuration of `rig`, and clear the retained topics of removed devices."""
        self._pose_ui_rate = RateDivider(rig.mqtt.pose_ui_hz)
        self._joint_rate = RateDivider(rig.mqtt.joint_hz)
        late_hz = 0.0 if rig.mqtt.spool is None else rig.mqtt.spool.pose_hz
        self._late_rate = RateDivider(late_hz) if late_hz > 0.0 else None

        devices = tuple(source.id for source in rig.sources)
        for removed in set(self._devices) - set(devices):
            for topic in (topics.DEVICE_AVAILABILITY, topics.DEVICE_INFO):
                self._publish(topic, b"", removed)
        for added in set(devices) - set(self._devices):  # offline until the first sample
            self._publish(topics.DEVICE_AVAILABILITY, OFFLINE, added)
        self._devices = devices

        self._publish(topics.BRIDGE_INFO, encode(_info(rig)))
        self._announce(rig)

    def _announce(self, rig: Rig) -> None:
        """Publish the discovery message for Home Assistant; remove it if discovery is off."""
        topic, settings = discovery_topic(rig.mqtt), rig.mqtt.home_assistant
        if self._discovery is not None and topic != self._discovery:
            self._outbox.retain(self._discovery, b"")
            self._components = {}
        self._discovery = topic
        if topic is None or settings is None:
            return
        if not settings.enabled:
            self._outbox.retain(topic, b"")
            return

        # Home Assistant removes an entity whose description contains only the platform.
        payload = discovery_payload(rig)
        removed = {
            key: {"platform": component["platform"]}
            for key, component in self._components.items()
            if key not in payload["components"]
        }
        self._components = payload["components"]
        self._outbox.retain(topic, encode(payload | {"components": self._components | removed}))

    def event(self, event: Event) -> None:
        """Do nothing, because inputs of the core are not published."""

    def output(self, output: Output) -> None:
        """Publish one output of the core; ignore calibration jobs and calibrations to store."""
        match output:
            case LimbState():
                self._publish_limb_state(output)
            case (
                OpticalState()
                | ChainModelState()
                | SensorStates()
                | RunningCenters()
                | StickFigure()
            ):
                topic, encoder = _STREAMS[type(output)]
                self._publish(topic, encoder(output, self._clock.offset_ns()))
            case Notice():
                self.publish_notice(output)
            case DeviceStatus(name, online):
                self._publish(topics.DEVICE_AVAILABILITY, ONLINE if online else OFFLINE, name)
            case DeviceInfo(name, data):
                self._publish(
                    topics.DEVICE_INFO, self._encode_stamped(printable_data(data), None), name
                )
            case CalibrationStatus():
                self._publish_calibration(output)
            case CalibrationProgress(t_ns, phase, progress, text, data):
                payload = {"phase": phase, "progress": progress, "text": text, "data": data}
                self._publish(topics.CALIBRATION_PROGRESS, self._encode_stamped(payload, t_ns))
            case Reply():
                self._publish_reply(output)
            case _:
                pass

    def _publish(self, topic: Topic, payload: bytes, value: str = "") -> None:
        """Add a message to the outbox; `value` replaces the placeholder in the topic."""
        name = topic.name(self._base, value)
        if topic.retained:
            self._outbox.retain(name, payload)
        elif topic.qos:
            self._outbox.event(name, payload)
        else:
            self._outbox.stream(name, payload)

    def _publish_limb_state(self, state: LimbState) -> None:
        offset_ns, now_ns = self._clock.offset_ns(), self._clock.now_ns()
        pose = encode_pose(state, offset_ns, now_ns)
        latency = self._latency
        written = None if latency is None else latency.mark_encoded()
        self._outbox.stream(self._pose_topic, pose, written)

        if self._pose_ui_rate.is_due(state.t_ns):
            self._outbox.stream(self._pose_ui_topic, pose)
        if self._spool and self._late_rate and self._late_rate.is_due(state.t_ns):
            self._spool.add(topics.LATE_POSE.pattern, pose)
        if self._joint_rate.is_due(state.t_ns):
            t_us = (state.t_ns + offset_ns) // 1000
            for i, joint in enumerate(state.joints):
                self._publish(topics.JOINT, encode_joint(state, i, t_us), joint.name)

    def publish_notice(self, notice: Notice) -> None:
        """Publish a notice on ``bridge/event``."""
        payload = {
            "kind": notice.kind,
            "id": notice.id,
            "level": notice.level,
            "text": printable(notice.text),
            "data": printable_data(notice.data),
        }
        event = self._encode_stamped(payload, notice.t_ns)
        self._publish(topics.BRIDGE_EVENT, event)
        if self._spool is not None:
            self._spool.add(topics.LATE_EVENT.pattern, event)

    def _publish_calibration(self, status: CalibrationStatus) -> None:
        payload: dict[str, Any] = {
            "phase": status.phase,
            "text": status.text,
            "version": status.version,
            "created_utc": status.created_utc,
            "kept": status.kept,
            "done": status.done,
            "quality": quality_payload(status.quality),
        }
        self._publish(topics.CALIBRATION, self._encode_stamped(payload, status.t_ns))

        data = {"quality": status.refused} if status.refused else {}
        self.publish_notice(
            Notice(
                status.t_ns, NoticeKind.CALIBRATION, status.phase, status.text, status.level, data
            )
        )

    def _publish_reply(self, reply: Reply) -> None:
        """Publish a reply on the client's response topic, or on ``bridge/response/COMMAND``."""
        address = reply.reply_to
        topic = address.topic or topics.RESPONSE.name(self._base, reply.command)

        # A reply may contain a list of faults. An error of the core has exactly one fault.
        error = None
        if reply.error is not None:
            fault = {key: reply.error.get(key) for key in ("key", "message")}
            error = {"faults": [fault], "more": 0} | dict(reply.error)
        payload = {
            "v": PAYLOAD_VERSION,
            "transaction": reply.transaction,
            "status": reply.status,
            "data": reply.data,
            "error": error,
        }
        self._outbox.respond(topic, encode(payload), correlation=address.correlation)

    def publish_health(self, health: BridgeHealth) -> None:
        """Publish ``bridge/health``."""
        payload = health_payload(health)
        self._publish(topics.BRIDGE_HEALTH, self._encode_stamped(payload, self._clock.now_ns()))

    def publish_log_line(self, level: str, name: str, text: str, suppressed: int) -> None:
        """Publish one log line on ``bridge/log``.

        `suppressed` is the number of lines that were omitted since the preceding published line.
        """
        line = {"level": level, "logger": name, "text": text, "suppressed": suppressed}
        self._publish(topics.BRIDGE_LOG, self._encode_stamped(line, self._clock.now_ns()))

    def _encode_stamped(self, data: Mapping[str, object], t_ns: int | None) -> bytes:
        stamp = {} if t_ns is None else {"t_us": (t_ns + self._clock.offset_ns()) // 1000}
        return encode({"v": PAYLOAD_VERSION} | stamp | dict(data))


def _sides(chain: Chain) -> dict[str, Any]:
    """Return the side of a limb; for a branched limb, also the connections of its joints."""
    if not chain.parents:
        return {"side": "left" if chain.left_side else "right"}
    parts = body_parts(chain)
    return {
        "side": "both",
        "connections": {
            name: {
                "parent": parts[above],
                "child": parts[below],
                "side": "left" if is_left(chain, number) else "right",
            }
            for number, (name, (above, below)) in enumerate(
                zip(chain.joints, joint_parts(chain), strict=True)
            )
            if number > 0
        },
    }


def _info(rig: Rig) -> dict[str, Any]:
    """Return the payload of ``bridge/info``."""
    config = orjson.dumps(rig.table, str, orjson.OPT_SORT_KEYS)
    if any(source.kind == "mocap" for source in rig.sources):
        world = (
            "z up; x, y and origin of the motion-capture system after a calibration with it; metres"
        )
    else:
        world = "z up; x east and y north, where the sensors know north; metres"
    return {
        "v": PAYLOAD_VERSION,
        "software": __version__,
        "rig": rig.name,
        "config_sha256": hashlib.sha256(config).hexdigest(),
        "output_rate_hz": rig.output_rate_hz,
        **_sides(rig.chain),
        "joints": rig.chain.joints,
        "angles": {
            joint.name: angle_convention(rig.chain, joint.number)
            for joint in inner_joints(rig.chain)
        },
        "segments": rig.chain.segments,
        "sensors": dict(zip(rig.chain.segments, rig.chain.sensors, strict=True)),
        "devices": {
            source.id: {"kind": source.kind, "driver": source.driver, "segment": source.segment}
            for source in rig.sources
        },
        "quaternions": "Hamilton, scalar first, segment to world",
        "world": world,
        "pose_bin": None,
    }
