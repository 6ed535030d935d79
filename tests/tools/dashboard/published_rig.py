"""A rig that publishes the topics of a calibrated leg, without daemon, sensors and simulator.

Tests of the page use this rig if they need no calibration, because it starts at once and needs
little CPU time.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import aiomqtt
import orjson

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

PERIOD_S = 0.1
"""Time between two messages `pose/ui`, s."""
HEALTH_POSES = 20
"""Number of poses between two health messages."""
WRITTEN_BYTES_S = 66_600
"""Growth of a recording, bytes/s: four IMUs at 100 Hz."""
THIGH_M, SHANK_M = 0.43, 0.39
STEP_S = 1.2
"""Period of the simulated walk, s."""
STAGES = ("decoded", "aligned", "fused", "encoded", "written", "total")
LATENCY = {f"{stage}_us": {"p50": 655.4, "p99": 1638.4, "max": 2904.5} for stage in STAGES}
HOUR_US = 3_600_000_000


def utc_text(t_us: int) -> str:
    """Return the ISO 8601 text of a UNIX time, µs."""
    return datetime.fromtimestamp(t_us // 1_000_000, UTC).isoformat()


def about_x(angle: float) -> list[float]:
    """Return the quaternion of a rotation about the x axis, rad."""
    return [math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]


def about_z(angle: float) -> list[float]:
    """Return the quaternion of a rotation about the z axis, rad."""
    return [math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]


def product(a: list[float], b: list[float]) -> list[float]:
    """Return the product of two quaternions."""
    (w, x, y, z), (p, q, r, s) = a, b
    return [
        w * p - x * q - y * r - z * s,
        w * q + x * p + y * s - z * r,
        w * r - x * s + y * p + z * q,
        w * s + x * r - y * q + z * p,
    ]


STORED = {
    "in_force": 3,
    "omitted": 0,
    "versions": [
        {
            "version": version, "created_utc": f"2026-11-2{version}T09:30:00Z", "usable": True,
            "method": "anchored", "functional": True, "flexion_deg": {"knee": 2.0 + 0.2 * version},
            "restored_from": None, "fault": None,
            "online": {
                "rounds": 1, "from_version": 2, "before_deg": {"thigh": 2.1, "knee": 2.6},
                "after_deg": {"thigh": 1.7, "knee": 1.9},
            } if version == 3 else None,
        }
        for version in (3, 2, 1)
    ],
}  # fmt: skip
"""Data of the answer to the request `calibrations`."""


RECORDING_FILE = "bench-1-20261123T091420-0001.mcap"
RECORDING = {
    "file": RECORDING_FILE, "duration_s": 724.0, "written_bytes": 48_213_000, "lost": 0,
    "failure": None, "free_bytes": 93_200_000_000, "active": True,
}  # fmt: skip
"""State of the recording at the start of a rig."""
STOPPED = {
    "file": "", "duration_s": 0.0, "written_bytes": 0, "lost": 0, "failure": None,
    "free_bytes": 93_200_000_000, "active": False,
}  # fmt: skip
"""State of the recording before the first start."""


@dataclass
class PublishedRig:
    """Payloads of a rig with the joints hip, knee and ankle."""

    name: str = "bench-1"
    sensors: dict[str, list[str]] = field(
        default_factory=lambda: {"thigh": ["S1", "S2"], "shank": ["S3", "S4"]}
    )
    base: str = "jointfit/bench-1"
    clock_offset_s: float = 0.0
    """Clock of the gateway minus clock of this machine, s."""
    lengths_known: bool = True
    """Whether the lengths of the segments, and thus the positions of knee and ankle, are known."""
    calibrated: bool = True
    """Whether orientations and angles are known."""
    offline: frozenset[str] = frozenset()
    """Devices without data."""
    version: int = 1
    """Version of the payloads."""
    account: tuple[str | None, str | None] = (None, None)
    """User name and password of the broker."""
    silent: bool = False
    """Whether the rig sends no poses but remains connected."""
    requests: list[dict[str, Any]] = field(default_factory=list)
    """Received requests, except the permission check that a page sends once."""
    commands: list[str] = field(default_factory=list)
    """Commands of the received requests."""
    turned: dict[str, tuple[str, float]] = field(default_factory=dict)
    """Rotation of each sensor about one of its own axes: axis and angle, deg."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Changed values of the message `calibration`, by key."""
    progress: dict[str, Any] | None = None
    """Content of `calibration/progress` during a calibration."""
    answer: dict[str, Any] = field(
        default_factory=lambda: {"status": "accepted", "data": {}, "error": None}
    )

    recording: dict[str, Any] = field(default_factory=lambda: dict(RECORDING))
    """State of the recording, which requests change."""
    marks: int = 0
    """Number of received marks."""
    answers: dict[str, dict[str, Any]] = field(
        default_factory=lambda: {"calibrations": {"status": "ok", "data": STORED}}
    )
    """Answers by command. All other commands except `record` and `mark` receive `answer`."""
    _began_s: float = field(default_factory=time.monotonic)

    @property
    def devices(self) -> dict[str, dict[str, Any]]:
        imus = {
            sensor: {"kind": "imu", "driver": "xbus", "segment": segment}
            for segment, sensors in self.sensors.items()
            for sensor in sensors
        }
        return imus | {"mocap": {"kind": "mocap", "driver": "natnet", "segment": None}}

    def now_us(self) -> int:
        return time.time_ns() // 1000 + int(self.clock_offset_s * 1e6)

    def retained(self) -> dict[str, dict[str, Any]]:
        """Return the retained messages of a rig that is online."""
        messages: dict[str, dict[str, Any]] = {
            "bridge/info": {
                "v": 1, "software": "0.1.0", "rig": self.name, "output_rate_hz": 100.0,
                "side": "right", "joints": ["hip", "knee", "ankle"],
                "angles": {"knee": "flexion"}, "segments": list(self.sensors),
                "sensors": self.sensors, "devices": self.devices,
            },
            "bridge/health": self.health(),
            "calibration": self.calibration(),
        }  # fmt: skip
        for device in self.devices:
            state = "offline" if device in self.offline else "online"
            messages[f"device/{device}/availability"] = {"v": 1, "state": state}
            messages[f"device/{device}/info"] = {"v": 1, "model": "MTi-3", "firmware": "1.7.0"}
        return messages | {"bridge/state": {"v": 1, "state": "online"}}

    def health(self) -> dict[str, Any]:
        def counters(device: str) -> dict[str, Any]:
            return {
                "online": device not in self.offline, "received": 81230, "used": 81101,
                "late": 12, "lost": 8, "corrupt": 0, "sensor": "ok", "clock": "passive",
                "sigma_us": 19.6, "delay_us": {"p50": 285.0, "p99": 1310.0, "max": 4120.3},
                "rate_hz": 100.0,
            }  # fmt: skip

        return {
            "v": 1, "t_us": self.now_us(),
            "devices": {name: counters(name) for name in self.devices},
            "frames": {"sent": 8100, "empty": 0, "skipped": 0},
            "process": {"cpu_pct": 9.1, "rss_bytes": 91000000},
            "latency": {"frames": 1000, **LATENCY},
            "learning": {"state": "waiting", "reason": "no live camera frames"},
            "link": {"connected": True, "sent": 9123, "dropped": 0, "denied": []},
            "recording": {"backlog_bytes": 0, **self._recorded()},
        }  # fmt: skip

    def _recorded(self) -> dict[str, Any]:
        grown_s = time.monotonic() - self._began_s if self.recording["active"] else 0.0
        size = self.recording["written_bytes"] + round(WRITTEN_BYTES_S * grown_s)
        duration_s = self.recording["duration_s"] + grown_s
        return self.recording | {"duration_s": duration_s, "written_bytes": size}

    def reply(self, command: str, request: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a request; `record` and `mark` change the state of the recording."""
        if command in self.answers:
            return self.answers[command]
        if command not in ("record", "mark") or self.answer["status"] == "error":
            return self.answer
        if command == "mark":
            self.marks += 1
            mark = {"number": self.marks, "t_us": self.now_us(), "text": request["text"]}
            return {"status": "ok", "data": mark}
        if request["action"] == "start" and not self.recording["active"]:
            self.recording = STOPPED | {"file": RECORDING_FILE, "active": True}
            self._began_s = time.monotonic()
        elif request["action"] == "stop":
            self.recording = self._recorded() | {"active": False}
        state = {"directory": "/var/lib/jointfitd/recordings", **self._recorded()}
        return {"status": "ok", "data": state}

    def calibration(self) -> dict[str, Any]:
        def tilted(degrees: float) -> list[float]:
            half = math.radians(degrees) / 2
            return [math.cos(half), 0.0, 0.0, math.sin(half)]

        names = [sensor for group in self.sensors.values() for sensor in group]
        joint = {"source": "markers", "sd_m": 0.0174, "arc_deg": 91.9}
        errors = {"anchored": 2.33, "mean": 4.57, "single": 5.33}
        quality = {
            "static": {"still_s": 5.05, "spread_deg": dict.fromkeys(names, 0.6584)},
            "alignment": {
                name: {"error_deg": 0.25, "rms_deg": 3.0, "lag_ms": None} for name in names
            },
            "anatomy": {
                "joints": dict.fromkeys(("hip", "knee", "ankle"), joint),
                "lengths_m": dict.fromkeys(self.sensors, 0.4281),
                "length_sd_m": dict.fromkeys(self.sensors, 0.0215),
                "length_sources": dict.fromkeys(self.sensors, "markers"),
            },
            "online": {
                "rounds": 1,
                "before_deg": {"thigh": 2.1, "shank": 2.2, "knee": 2.6},
                "after_deg": {"thigh": 1.7, "shank": 1.8, "knee": 1.9},
                "known_after_deg": {"thigh": 2.0, "shank": 2.1, "knee": 2.4},
            },
            "holdout": {
                "method": "anchored",
                "segments_deg": dict.fromkeys(self.sensors, errors),
                "flexion_deg": {"knee": errors},
            },
            "sensors": {
                name: {"q_sensor_segment": tilted(15.0 * i), "q_optical_world": [1, 0, 0, 0]}
                for i, name in enumerate(names)
            },
        }
        return {
            "v": 1, "t_us": self.now_us(), "phase": "calibrated", "text": "stored as version 3",
            "version": 3, "kept": None, "done": [], "quality": quality,
            "created_utc": utc_text(self.now_us() - 2 * HOUR_US),
        } | self.changes  # fmt: skip

    def poses(self, seq: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return `pose/ui` and `optical/pose` of a walking subject at the current time."""
        t_us = self.now_us()
        angle = 2.0 * math.pi * t_us / 1e6 / STEP_S
        hip = math.radians(22.0) * math.cos(angle)
        knee = math.radians(32.0 - 28.0 * math.cos(angle - 1.9))
        optical_error = math.radians(1.5) * math.sin(angle / 3.0)
        pose = self._limb(hip, knee)
        optical = self._limb(hip, knee + optical_error)
        pose |= {"v": 1, "seq": seq, "t_us": t_us, "mode": "imu+mocap", "sync": "locked"}
        if not self.calibrated:
            pose["flags"] = ["uncalibrated"]
            for part in (*pose["segments"].values(), *pose["joints"].values()):
                part.update(dict.fromkeys(part))
            return pose, optical | {"v": 1, "t_us": t_us, "frame": seq}
        return pose | {"flags": []}, optical | {"v": 1, "t_us": t_us, "frame": seq}

    def orientations(self) -> dict[str, Any]:
        """Return `sensors/pose` for sensors with different headings, each rotated by `turned`."""
        sensors = {}
        for i, name in enumerate(name for group in self.sensors.values() for name in group):
            axis, degrees = self.turned.get(name, ("x", 0.0))
            half = math.radians(degrees) / 2
            turn = [math.cos(half), *(math.sin(half) if key == axis else 0.0 for key in "xyz")]
            sensors[name] = {"q": product(about_z(0.5 * i), turn), "q_segment": None}
        return {"v": 1, "t_us": self.now_us(), "sensors": sensors, "joints": {}}

    def _limb(self, hip: float, knee: float) -> dict[str, Any]:
        (thigh, shank), p = [*self.sensors], [0.06, 0.02, 0.86]
        shank_angle = hip - knee

        def below(point: list[float], angle: float, length: float) -> list[float]:
            return [
                point[0],
                point[1] + length * math.sin(angle),
                point[2] - length * math.cos(angle),
            ]

        middle = below(p, hip, THIGH_M)
        end = below(middle, shank_angle, SHANK_M)
        flexion = math.degrees(knee)
        unknown = None if self.lengths_known else {"p_m": None, "sd_m": None}
        return {
            "segments": {
                thigh: {"q": about_x(hip), "sd_deg": 0.9, "used": self.sensors[thigh]},
                shank: {"q": about_x(shank_angle), "sd_deg": 1.6, "used": self.sensors[shank]},
            },
            "joints": {
                "hip": {"p_m": p, "sd_m": 0.0},
                "knee": {
                    "p_m": middle, "sd_m": 0.016, "flexion_deg": round(flexion, 2),
                    "adduction_deg": -0.7, "rotation_deg": 2.1,
                    "inner_deg": round(180 - flexion, 2),
                    "sd_deg": 2.1, "flexion_deg_s": 61.2, "adduction_deg_s": 1.8,
                    "rotation_deg_s": -3.1,
                } | (unknown or {}),
                "ankle": unknown or {"p_m": end, "sd_m": 0.027},
            },
        }  # fmt: skip


@contextlib.asynccontextmanager
async def publishing(rig: PublishedRig, port: int) -> AsyncIterator[None]:
    """Publish the topics of a rig during the ``with`` block; reconnect like the daemon."""
    task = asyncio.create_task(_publish(rig, port), name="published rig")
    try:
        yield
    finally:
        # A task can lose its cancellation: before Python 3.12, asyncio.wait_for discards it if the
        # awaited future completes at the same time, and an error of the client during disconnection
        # replaces it. Therefore cancel the task until it ends.
        while not task.done():
            task.cancel()
            await asyncio.wait([task], timeout=1.0)


async def _publish(rig: PublishedRig, port: int) -> None:
    will = aiomqtt.Will(f"{rig.base}/bridge/state", b'{"v":1,"state":"offline"}', 1, retain=True)
    while True:
        with contextlib.suppress(aiomqtt.MqttError):
            async with aiomqtt.Client(
                "127.0.0.1",
                port,
                protocol=aiomqtt.ProtocolVersion.V5,
                will=will,
                username=rig.account[0],
                password=rig.account[1],
            ) as client:
                await client.subscribe(f"{rig.base}/bridge/request/+", qos=1)
                answers = asyncio.create_task(_answer(rig, client), name="published answers")
                try:
                    await _publish_poses(rig, client)
                finally:
                    while not answers.done():
                        answers.cancel()
                        await asyncio.wait([answers], timeout=1.0)
                    # The broker sends no will message for a client that disconnects.
                    await client.publish(will.topic, will.payload, 1, retain=True)
        await asyncio.sleep(0.2)


async def _publish_poses(rig: PublishedRig, client: aiomqtt.Client) -> None:
    for topic, payload in rig.retained().items():
        payload["v"] = rig.version
        await client.publish(f"{rig.base}/{topic}", orjson.dumps(payload), 1, retain=True)
    seq = 0
    while True:
        pose, optical = rig.poses(seq)
        pose["v"] = optical["v"] = rig.version
        if not rig.silent:
            await client.publish(f"{rig.base}/pose/ui", orjson.dumps(pose))
            await client.publish(f"{rig.base}/optical/pose", orjson.dumps(optical))
            orientations = orjson.dumps(rig.orientations())
            await client.publish(f"{rig.base}/sensors/pose", orientations)
        if rig.progress is not None:
            progress = orjson.dumps({"v": rig.version, "t_us": rig.now_us()} | rig.progress)
            await client.publish(f"{rig.base}/calibration/progress", progress)
        if seq % HEALTH_POSES == HEALTH_POSES - 1:
            health = orjson.dumps(rig.health() | {"v": rig.version})
            await client.publish(f"{rig.base}/bridge/health", health, 1, retain=True)
        seq += 1
        await asyncio.sleep(PERIOD_S)


async def _answer(rig: PublishedRig, client: aiomqtt.Client) -> None:
    with contextlib.suppress(aiomqtt.MqttError):
        async for message in client.messages:
            request = orjson.loads(bytes(message.payload))
            command = message.topic.value.rpartition("/")[2]
            if request.get("count") != 1:
                rig.requests.append(request)
                rig.commands.append(command)
            found = rig.reply(command, request)
            answer = {"v": 1, "transaction": request.get("transaction"), **found}
            topic = message.topic.value.replace("/request/", "/response/")
            await client.publish(topic, orjson.dumps(answer), 1)
            if command == "record":
                health = orjson.dumps(rig.health())
                await client.publish(f"{rig.base}/bridge/health", health, 1, retain=True)
            if command == "mark" and found["status"] == "ok":
                event = {"v": 1, "kind": "mark", "id": rig.name, "level": "info"}
                text, number = found["data"]["text"], found["data"]["number"]
                event |= {"t_us": found["data"]["t_us"], "text": text, "data": {"number": number}}
                await client.publish(f"{rig.base}/bridge/event", orjson.dumps(event), 1)
