"""Puts what the core says on its topics. Law: synchronous, and never waits for a broker.

The topics, their rates and their retained flags are the contract of docs/mqtt.md.
"""

from __future__ import annotations

import hashlib
import time
from typing import TYPE_CHECKING, Any

import orjson

from jointfit_daemon import __version__
from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.log import printable, printable_data
from jointfit_daemon.outputs.mqtt import OFFLINE, ONLINE, PAYLOAD_VERSION
from jointfit_daemon.outputs.payloads._encoding import encode, encode_joint, encode_pose
from jointfit_daemon.outputs.payloads._quality_units import shown
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline.events import (
    CalibrationProgress,
    CalibrationStatus,
    DeviceInfo,
    DeviceStatus,
    Notice,
    Reply,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.config import Rig
    from jointfit_daemon.outputs.mqtt import Outbox
    from jointfit_daemon.pipeline.events import Output

_NS_PER_S = 1_000_000_000


class _Pace:
    """Lets one through every period, on a grid of its own so that the mean rate is kept."""

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = round(_NS_PER_S / rate_hz)
        self._next_ns = 0

    def due(self, now_ns: int) -> bool:
        if now_ns < self._next_ns:
            return False
        late = now_ns - self._next_ns > self._period_ns
        self._next_ns = (now_ns if late else self._next_ns) + self._period_ns
        return True


class TopicWriter:
    """Writes one rig's topics into an outbox.

    Parameters
    ----------
    rig
        Gives names, base topic and rates.
    outbox
        Takes the messages.
    """

    def __init__(self, rig: Rig, outbox: Outbox) -> None:
        self._base, self._outbox, self._clock = rig.mqtt.base, outbox, UnixClock()
        self._pose_ui, self._joints = _Pace(rig.mqtt.pose_ui_hz), _Pace(rig.mqtt.joint_hz)
        self._pose_topic = f"{self._base}/pose"
        self._devices: tuple[str, ...] = ()
        self.configure(rig)

    def configure(self, rig: Rig) -> None:
        """Tell the rig's layout; devices that are gone lose their retained topics."""
        self._pose_ui, self._joints = _Pace(rig.mqtt.pose_ui_hz), _Pace(rig.mqtt.joint_hz)
        devices = tuple(source.id for source in rig.sources)
        for gone in set(self._devices) - set(devices):
            for leaf in ("availability", "info"):
                self._outbox.retain(f"{self._base}/device/{gone}/{leaf}", b"")
        for new in set(devices) - set(self._devices):  # absent until heard
            self._outbox.retain(f"{self._base}/device/{new}/availability", OFFLINE)
        self._devices = devices
        self._outbox.retain(f"{self._base}/bridge/info", encode(_info(rig)))

    def handle(self, output: Output) -> None:
        """Publish one output of the core; those meant for others are ignored."""
        match output:
            case LimbState():
                self._limb_state(output)
            case Notice():
                self.event(output)
            case DeviceStatus(name, online):
                topic = f"{self._base}/device/{name}/availability"
                self._outbox.retain(topic, ONLINE if online else OFFLINE)
            case DeviceInfo(name, data):
                info = self._stamped(printable_data(data), None)
                self._outbox.retain(f"{self._base}/device/{name}/info", info)
            case CalibrationStatus():
                self._calibration(output)
            case CalibrationProgress():
                self._progress(output)
            case _:  # jobs and replies: the supervisor's
                pass

    def _limb_state(self, state: LimbState) -> None:
        offset_ns, now_ns = self._clock.offset_ns(), time.monotonic_ns()
        pose = encode_pose(state, offset_ns, now_ns)
        self._outbox.stream(self._pose_topic, pose)
        if self._pose_ui.due(state.t_ns):
            self._outbox.stream(f"{self._pose_topic}/ui", pose)
        if self._joints.due(state.t_ns):
            t_us = (state.t_ns + offset_ns) // 1000
            for i, joint in enumerate(state.joints):
                payload = encode_joint(state, i, t_us)
                self._outbox.stream(f"{self._base}/joint/{joint.name}", payload)

    def event(self, notice: Notice, level: str | None = None) -> None:
        """Publish one change of state on ``bridge/event``, at its own level or at `level`."""
        said = {"kind": notice.kind, "id": notice.id, "level": level or notice.level}
        said |= {"text": printable(notice.text), "data": printable_data(notice.data)}
        payload = self._stamped(said, notice.t_ns)
        self._outbox.event(f"{self._base}/bridge/event", payload)

    def _calibration(self, status: CalibrationStatus) -> None:
        said: dict[str, Any] = {"phase": status.phase, "text": status.text}
        said |= {"version": status.version, "kept": status.kept, "quality": shown(status.quality)}
        self._outbox.retain(f"{self._base}/calibration", self._stamped(said, status.t_ns))
        data = {"quality": status.refused} if status.refused else {}
        event = Notice(status.t_ns, "calibration", status.phase, status.text, status.level, data)
        self.event(event)

    def _progress(self, progress: CalibrationProgress) -> None:
        said = {"phase": progress.phase, "progress": progress.progress, "text": progress.text}
        payload = self._stamped(said | {"data": progress.data}, progress.t_ns)
        self._outbox.stream(f"{self._base}/calibration/progress", payload)

    def reply(self, reply: Reply, response_topic: str | None, correlation: bytes | None) -> None:
        """Answer one request, where it wants the answer or on ``bridge/response/COMMAND``."""
        topic = response_topic or f"{self._base}/bridge/response/{reply.command}"
        said = {"v": PAYLOAD_VERSION, "transaction": reply.transaction, "status": reply.status}
        payload = encode(said | {"data": reply.data, "error": reply.error})
        self._outbox.event(topic, payload, correlation=correlation)

    def health(self, figures: Mapping[str, object]) -> None:
        """Publish ``bridge/health``."""
        self._outbox.retain(
            f"{self._base}/bridge/health", self._stamped(figures, time.monotonic_ns())
        )

    def log_line(self, level: str, name: str, text: str, suppressed: int) -> None:
        """Publish one line of the log on ``bridge/log``."""
        said = {"level": level, "logger": name, "text": text, "suppressed": suppressed}
        self._outbox.stream(f"{self._base}/bridge/log", self._stamped(said, time.monotonic_ns()))

    def _stamped(self, data: Mapping[str, object], t_ns: int | None) -> bytes:
        stamp = {} if t_ns is None else {"t_us": (t_ns + self._clock.offset_ns()) // 1000}
        return encode({"v": PAYLOAD_VERSION} | stamp | dict(data))


def _info(rig: Rig) -> dict[str, Any]:
    config = orjson.dumps(rig.table, str, orjson.OPT_SORT_KEYS)
    return {
        "v": PAYLOAD_VERSION,
        "software": __version__,
        "rig": rig.name,
        "config_sha256": hashlib.sha256(config).hexdigest(),
        "output_rate_hz": rig.output_rate_hz,
        "side": "left" if rig.chain.left_side else "right",
        "joints": rig.chain.joints,
        "segments": rig.chain.segments,
        "sensors": dict(zip(rig.chain.segments, rig.chain.sensors, strict=True)),
        "devices": {
            source.id: {"kind": source.kind, "driver": source.driver, "segment": source.segment}
            for source in rig.sources
        },
        "quaternions": "Hamilton, scalar first, segment to world",
        "world": _world(rig),
        "pose_bin": None,
    }


def _world(rig: Rig) -> str:
    """Return in words which axes positions and orientations refer to."""
    if any(source.kind == "mocap" for source in rig.sources):
        return "z up; x, y and origin of the motion capture, once calibrated with it; metres"
    return "z up; x east and y north, where the sensors know north; metres"
