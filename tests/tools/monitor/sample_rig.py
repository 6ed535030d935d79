"""Messages of a walking subject's rig at fixed times; each payload fits its payload model."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import UTC
from typing import Any

from jointfit_daemon.outputs.payload_models import PAYLOADS, payload_topic
from jointfit_daemon.tools.monitor._monitor_state import MonitorState
from jointfit_daemon.tools.monitor._rig_view import Moment

BASE = "jointfit/bench-1"
START_US = 1_795_250_060_000_000
"""UNIX time of the first pose: 2026-11-21 08:34:20 UTC."""
START_S = 5_000.0
"""Monotonic time of the first pose, s."""
PERIOD_S = 0.1
THIGH_M, SHANK_M = 0.43, 0.39
STEP_S = 1.2
RECORDING = {
    "file": "bench-1-20261121T082216-0001.mcap", "duration_s": 724.0, "written_bytes": 48_213_000,
    "lost": 0, "failure": None, "free_bytes": 93_200_000_000, "active": True,
}  # fmt: skip
LEG = {"thigh": ["S1", "S2"], "shank": ["S3", "S4"]}


def moment(seconds: float) -> Moment:
    """Return the time of this machine, `seconds` after the first pose."""
    return Moment(START_S + seconds, START_US + 1e6 * seconds)


def about_x(angle: float) -> list[float]:
    return [math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]


@dataclass
class SampleRig:
    """A chain of segments that swing in the sagittal plane."""

    name: str = "bench-1"
    sensors: dict[str, list[str]] = field(default_factory=lambda: dict(LEG))
    joints: tuple[str, ...] = ("hip", "knee", "ankle")
    offline: frozenset[str] = frozenset()
    cameras: bool = True
    recording: dict[str, Any] = field(default_factory=lambda: dict(RECORDING))
    clock_offset_s: float = 0.0
    """Clock of the gateway minus clock of the terminal, s."""

    def t_us(self, seconds: float) -> int:
        return START_US + round(1e6 * (seconds + self.clock_offset_s))

    @property
    def devices(self) -> dict[str, dict[str, Any]]:
        found: dict[str, dict[str, Any]] = {
            sensor: {"kind": "imu", "driver": "xbus", "segment": segment}
            for segment, sensors in self.sensors.items()
            for sensor in sensors
        }
        if self.cameras:
            found["mocap"] = {"kind": "mocap", "driver": "natnet", "segment": None}
        return found

    def info(self) -> dict[str, Any]:
        return {
            "v": 1, "software": "0.1.0", "rig": self.name, "config_sha256": "0" * 64,
            "output_rate_hz": 100.0, "side": "right", "joints": [*self.joints],
            "angles": dict.fromkeys(self.joints[1:-1], "knee"), "segments": [*self.sensors],
            "sensors": self.sensors, "devices": self.devices, "quaternions": "Hamilton",
            "world": "z up", "pose_bin": None,
        }  # fmt: skip

    def health(self, seconds: float = 0.0) -> dict[str, Any]:
        zero = dict.fromkeys(
            ("decimated", "idle", "duplicate", "dropped", "pending", "corrupt", "discarded_bytes",
             "restarts", "reconnects", "epoch"), 0)  # fmt: skip
        counts = {
            name: {
                **zero, "online": name not in self.offline, "received": 81230, "used": 81218,
                "late": 12, "lost": 8, "last_age_ms": 4.2, "clock": "passive", "offset_us": 8.1e7,
                "skew_ppm": 11.8, "sigma_us": 19.6, "bound_us": None,
                "latency_prior_us": [200.0, 200.0], "jitter_us": 85.0,
                "delay_us": {"p50": 285.0, "p99": 1310.0, "max": 4120.3}, "rate_hz": 100.0,
                "sensor": "ok" if device["kind"] == "imu" else None,
            }
            for name, device in self.devices.items()
        }  # fmt: skip
        return {
            "v": 1, "t_us": self.t_us(seconds), "devices": counts,
            "calibration": {"phase": "calibrated", "version": 3}, "fusion": {}, "lags": {},
            "frames": {"sent": 8100, "empty": 0, "skipped": 0},
            "learning": {"state": "waiting", "reason": "no live camera frames", "stopped_s": None,
                         "kept": 412},
            "process": {"cpu_pct": 9.1, "rss_bytes": 91_000_000, "loop_delay_p99_ms": 1.1},
            "link": {"connected": True, "connects": 1, "confirmed": True, "denied": [],
                     "sent": 9123, "queued": 0, "dropped": 0, "ignored_requests": 0, "noise": 0},
            "state": {"fault": None, "not_stored": None},
            "recording": {"backlog_bytes": 0, **self.recording},
        }  # fmt: skip

    def calibration(self, phase: str = "calibrated", **changes: Any) -> dict[str, Any]:
        errors = {"anchored": 2.33, "mean": 4.57, "single": 5.33}
        quality = {
            "static": {"still_s": 5.05, "spread_deg": {}},
            "alignment": {},
            "holdout": {
                "method": "anchored",
                "segments_deg": dict.fromkeys(self.sensors, errors),
                "flexion_deg": dict.fromkeys(self.joints[1:-1], errors),
            },
            "anatomy": {
                "joints": {name: {"source": "markers", "sd_m": 0.0174} for name in self.joints},
                "lengths_m": dict.fromkeys(self.sensors, 0.4281),
            },
        }
        done = phase == "calibrated"
        return {
            "v": 1, "t_us": self.t_us(0), "phase": phase, "kept": None,
            "done": [], "created_utc": "2026-11-21T06:30:00+00:00" if done else None,
            "text": "stored as version 3" if done else "", "version": 3 if done else None,
            "quality": quality if done else {},
        } | changes  # fmt: skip

    def progress(self) -> dict[str, Any]:
        joint = {"source": "markers", "predicted_error_mm": 20.7, "noise_error_mm": 2.1,
                 "arc_deg": 64.2, "conditioning": 81.9, "frames": 2931, "unseen": None,
                 "met": True}  # fmt: skip
        missing = "knee: 9 of 12 flexions so far: walk, squat, sit down and stand up"
        return {
            "v": 1, "t_us": self.t_us(0), "phase": "functional", "progress": 0.4, "text": missing,
            "data": {
                "joints": {
                    "hip": joint,
                    "knee": joint | {"met": False, "bends": 9, "source": "markers, static pose"},
                    "ankle": joint | {"source": "configured", "predicted_error_mm": None,
                                      "noise_error_mm": None, "arc_deg": None},
                },
                "parts": {"pelvis": {"seen_pct": 98.1}, "thigh": {"seen_pct": 99.7},
                          "shank": {"seen_pct": 100.0}},
                "missing": [missing],
            },
        }  # fmt: skip

    def event(self, text: str, *, id: str = "S3", level: str = "info", at_s: float = 0.0) -> Any:
        return {"v": 1, "t_us": self.t_us(at_s), "kind": "device", "id": id, "level": level,
                "text": text, "data": {}}  # fmt: skip

    def versions(self) -> dict[str, Any]:
        return {
            "store": "/var/lib/jointfitd/calibration", "in_force": 3, "omitted": 0,
            "versions": [
                {
                    "version": version, "created_utc": f"2026-11-2{version}T09:30:00+00:00",
                    "software": "0.1.0", "method": "anchored", "procedure": "corrected",
                    "restored_from": None, "online": None, "functional": True,
                    "usable": version != 1,
                    "segments_deg": {}, "flexion_deg": {"knee": 2.0 + 0.2 * version},
                    "fault": None,
                }
                for version in (3, 2, 1)
            ],
        }  # fmt: skip

    def _angles(self, seconds: float) -> list[float]:
        """Return the angle of every segment from the vertical, rad, positive forward."""
        phase = 2.0 * math.pi * seconds / STEP_S
        thigh = math.radians(22.0) * math.cos(phase)
        bend = math.radians(32.0 - 28.0 * math.cos(phase - 1.9))
        return [thigh - bend * k for k in range(len(self.sensors))]

    def _limb(self, seconds: float, error: float) -> dict[str, Any]:
        place = [0.06, 0.02, 0.86]
        points, angles = [place], self._angles(seconds)
        for k, angle in enumerate(angles):
            length = THIGH_M if k == 0 else SHANK_M
            turned = angle - (error if k else 0.0)
            place = [place[0], place[1] + length * math.sin(turned),
                     place[2] - length * math.cos(turned)]  # fmt: skip
            points.append(place)
        joints: dict[str, dict[str, Any]] = {}
        for k, name in enumerate(self.joints):
            joints[name] = {"p_m": [round(value, 4) for value in points[k]]}
            if 0 < k < len(angles):
                flexion = math.degrees(angles[k - 1] - angles[k] + error)
                joints[name] |= {
                    "flexion_deg": round(flexion, 2), "adduction_deg": -0.71, "rotation_deg": 2.08,
                    "inner_deg": round(180 - flexion, 2),
                }  # fmt: skip
        segments = {
            name: {"q": about_x(angle)} for name, angle in zip(self.sensors, angles, strict=True)
        }
        return {"segments": segments, "joints": joints}

    def pose(self, seconds: float, flags: tuple[str, ...] = ()) -> dict[str, Any]:
        limb, t_us = self._limb(seconds, 0.0), self.t_us(seconds)
        for name, segment in limb["segments"].items():
            segment |= {"sd_deg": 0.9, "used": self.sensors[name]}
        for k, joint in enumerate(limb["joints"].values()):
            joint |= {"sd_m": 0.01 * k}
            if "flexion_deg" in joint:
                joint |= {"sd_deg": 2.1, "flexion_deg_s": 61.2, "adduction_deg_s": 1.8,
                          "rotation_deg_s": -3.1}  # fmt: skip
        return limb | {
            "v": 1, "seq": round(100 * seconds), "t_us": t_us, "completed_us": t_us + 3000,
            "mono_us": round(1e6 * (START_S + seconds)), "age_ms": 4.1, "mode": "imu+mocap",
            "sync": "locked", "flags": [*flags],
        }  # fmt: skip

    def optical(self, seconds: float) -> dict[str, Any]:
        limb = self._limb(seconds, math.radians(2.5) * math.sin(2.0 * seconds))
        for segment in limb["segments"].values():
            segment |= {"residual_deg": 1.1, "residual_rms_deg": 1.3}
        for joint in limb["joints"].values():
            joint |= {"gap_m": 0.004, "residual_m": 0.008, "residual_rms_m": 0.009}
        return limb | {"v": 1, "t_us": self.t_us(seconds), "frame": round(100 * seconds)}

    def retained(self) -> dict[str, Any]:
        """Return the retained messages of a rig that is online."""
        devices = {
            f"device/{name}/availability": {
                "v": 1, "state": "offline" if name in self.offline else "online"
            }
            for name in self.devices
        }  # fmt: skip
        return {
            "bridge/info": self.info(), "bridge/health": self.health(),
            "calibration": self.calibration(), **devices,
            "bridge/state": {"v": 1, "state": "online"},
        }  # fmt: skip


def connected_state(**options: Any) -> MonitorState:
    """Return the state of a monitor that is connected and has chosen its rig."""
    state = MonitorState("localhost:1883", timezone=UTC, **options)
    state.begin_rig(BASE)
    state.set_connected()
    return state


def take(state: MonitorState, topic: str, payload: Any, seconds: float = 0.0) -> None:
    """Pass a valid message to the state."""
    model = payload_topic(topic)
    assert model is not None, topic
    PAYLOADS[model].model_validate(payload)
    state.rig.take(topic, payload, moment(seconds))


def live_state(
    rig: SampleRig, seconds: float = 12.0, flags: tuple[str, ...] = (), **options: Any
) -> MonitorState:
    """Return the state after a walk of `seconds`."""
    state = connected_state(**options)
    for topic, payload in rig.retained().items():
        take(state, topic, payload)
    for k in range(round(seconds / PERIOD_S) + 1):
        at_s = k * PERIOD_S
        take(state, "pose/ui", rig.pose(at_s, flags), at_s)
        if rig.cameras:
            take(state, "optical/pose", rig.optical(at_s), at_s)
    return state
