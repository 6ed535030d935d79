"""What goes on which topic, and how often. Law: takes outputs of the core, fills the outbox.

The contract is docs/mqtt.md: state is retained, events are sent once, poses are streams.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from jointfit_daemon import __version__
from jointfit_daemon.outputs.payloads import (
    PAYLOAD_VERSION,
    UnixClock,
    encode,
    encode_joint,
    encode_pose,
)
from jointfit_daemon.pipeline.events import (
    CalibrationProgress,
    CalibrationStatus,
    DeviceInfo,
    DeviceStatus,
    Notice,
    Reply,
)

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig
    from jointfit_daemon.model import LimbState
    from jointfit_daemon.outputs.mqtt import Incoming
    from jointfit_daemon.outputs.outbox import Outbox
    from jointfit_daemon.pipeline.events import Output

_NS, _NS_PER_US = 1_000_000_000, 1000
_PENDING = 64  # requests waiting for their answer; each is answered once, soon
HEALTH_SOON_S = 0.5
"""Health follows a device that came or went by this much, so that losses show in time."""

_STATES = {True: {"state": "online"}, False: {"state": "offline"}}


class Board:
    """Publishes for one rig.

    Parameters
    ----------
    rig : Rig
        Names become topics; ``rig.mqtt`` sets the decimated rates.
    outbox : Outbox
        Where messages wait for the broker.
    """

    def __init__(self, rig: Rig, outbox: Outbox) -> None:
        self._outbox, self._unix = outbox, UnixClock()
        self._ui_ns = self._joint_ns = 0
        self._health_due_s: float | None = None
        self._answers: dict[tuple[str, str], tuple[str, bytes | None]] = {}
        self._online: dict[str, bool] = {}
        self.configure(rig)

    def configure(self, rig: Rig) -> None:
        """Take a rig into force: tell who we are, forget devices that are gone."""
        self._rig, self._base = rig, rig.mqtt.base
        ids = {source.id for source in rig.sources}
        for gone in [name for name in self._online if name not in ids]:
            del self._online[gone]
            for topic in ("availability", "info"):
                self._outbox.retain(self._topic(f"device/{gone}/{topic}"), b"")
        for source in rig.sources:
            if source.id not in self._online:
                self.tell(DeviceStatus(source.id, online=False))
        self._retain("bridge/info", _info(rig))

    @property
    def online_imus(self) -> int:
        """How many IMUs stream just now."""
        return sum(
            self._online.get(source.id, False)
            for source in self._rig.sources
            if source.kind == "imu"
        )

    # --- the limb ----------------------------------------------------------------------------

    def pose(self, state: LimbState) -> None:
        """Publish one frame, and its decimated forms when they are due."""
        now_ns = time.monotonic_ns()
        offset_ns = self._unix.offset_ns()
        payload = encode_pose(state, offset_ns, now_ns)
        self._outbox.stream(self._topic("pose"), payload)
        mqtt = self._rig.mqtt
        if state.t_ns - self._ui_ns >= _NS / mqtt.pose_ui_hz:
            self._ui_ns = state.t_ns
            self._outbox.stream(self._topic("pose/ui"), payload)
        if state.t_ns - self._joint_ns >= _NS / mqtt.joint_hz:
            self._joint_ns = state.t_ns
            t_us = (state.t_ns + offset_ns) // _NS_PER_US
            for joint in state.joints:
                self._outbox.stream(
                    self._topic(f"joint/{joint.name}"), encode_joint(joint, t_us)
                )

    # --- everything else ---------------------------------------------------------------------

    def tell(self, output: Output) -> None:
        """Publish one output that is not a frame; what has no topic is ignored."""
        if isinstance(output, Notice):
            self._event("bridge/event", self._notice(output))
        elif isinstance(output, DeviceStatus):
            self._device(output)
        elif isinstance(output, DeviceInfo):
            self._retain(f"device/{output.id}/info", dict(output.data))
        elif isinstance(output, CalibrationStatus):
            self._retain("calibration", self._calibration(output))
        elif isinstance(output, CalibrationProgress):
            payload = {
                "t_us": self._us(output.t_ns),
                "phase": output.phase,
                "progress": output.progress,
                "text": output.text,
                **output.data,
            }
            self._outbox.stream(self._topic("calibration/progress"), _bytes(payload))
        elif isinstance(output, Reply):
            self._reply(output)

    def health(self, health: dict[str, Any]) -> None:
        """Publish the counters and clocks of everything."""
        self._health_due_s = None
        self._retain("bridge/health", {"t_us": self._us(time.monotonic_ns()), **health})

    def health_wanted(self, now_s: float) -> bool:
        """Tell whether a device came or went a moment ago and its counters are worth telling."""
        return self._health_due_s is not None and now_s >= self._health_due_s

    def asked(self, message: Incoming, transaction: str) -> None:
        """Remember where the answer to a request goes."""
        command = message.topic.rpartition("/")[2]
        topic = message.response_topic or self._topic(f"bridge/response/{command}")
        while len(self._answers) >= _PENDING:
            self._answers.pop(next(iter(self._answers)))
        self._answers[command, transaction] = topic, message.correlation

    def _reply(self, reply: Reply) -> None:
        default = self._topic(f"bridge/response/{reply.command}"), None
        topic, correlation = self._answers.pop((reply.command, reply.transaction), default)
        payload = {
            "transaction": reply.transaction,
            "status": reply.status,
            "data": dict(reply.data),
            "error": None if reply.error is None else dict(reply.error),
        }
        self._outbox.event(topic, _bytes(payload), correlation=correlation)

    def _device(self, status: DeviceStatus) -> None:
        if self._online.get(status.id) is not status.online:
            self._health_due_s = time.monotonic() + HEALTH_SOON_S
        self._online[status.id] = status.online
        self._retain(f"device/{status.id}/availability", _STATES[status.online])

    def _notice(self, notice: Notice) -> dict[str, Any]:
        return {
            "t_us": self._us(notice.t_ns),
            "kind": notice.kind,
            "id": notice.id,
            "text": notice.text,
            "level": notice.level,
            "data": dict(notice.data),
        }

    def _calibration(self, status: CalibrationStatus) -> dict[str, Any]:
        return {
            "t_us": self._us(status.t_ns),
            "phase": status.phase,
            "text": status.text,
            "version": status.version,
            "quality": dict(status.quality),
        }

    def _us(self, t_ns: int) -> int:
        return (t_ns + self._unix.offset_ns()) // _NS_PER_US

    def _topic(self, below: str) -> str:
        return f"{self._base}/{below}"

    def _retain(self, below: str, payload: dict[str, Any]) -> None:
        self._outbox.retain(self._topic(below), _bytes(payload))

    def _event(self, below: str, payload: dict[str, Any]) -> None:
        self._outbox.event(self._topic(below), _bytes(payload))


def _bytes(payload: dict[str, Any]) -> bytes:
    return encode({"v": PAYLOAD_VERSION, **payload})


def _info(rig: Rig) -> dict[str, Any]:
    return {
        "software": __version__,
        "rig": rig.name,
        "output_rate_hz": rig.output_rate_hz,
        "joints": rig.chain.joints,
        "segments": rig.chain.segments,
        "sensors": {
            segment: sensors
            for segment, sensors in zip(rig.chain.segments, rig.chain.sensors, strict=True)
        },
        "units": {"q": "1", "p_m": "m", "sd_deg": "deg", "t_us": "us since 1970"},
        "frames": "q: w, x, y, z, segment to world; world z up; segment x right, y front, z up",
    }
