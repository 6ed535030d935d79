"""A `PublishedRig` with the limb of any rig.toml, even with many segments or two branches."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson
from typing_extensions import override  # typing contains `override` from Python 3.12

from jointfit_daemon.config import load_rig
from jointfit_daemon.outputs.payloads._topic_writer import _info
from tests.tools.dashboard.published_rig import STEP_S, PublishedRig, about_x

if TYPE_CHECKING:
    from collections.abc import Iterator

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
LENGTH_M = 0.4
"""Length of every segment, m."""
ANGLES = {
    "flexion": ("flexion", "adduction", "rotation"),
    "elevation": ("plane", "elevation", "rotation"),
    "trunk": ("flexion", "bending", "rotation"),
}
"""Names of the angles of a joint, by angle convention."""


@dataclass
class ExampleRig(PublishedRig):
    """Payloads of the rig in `file`; every joint swings."""

    file: Path = EXAMPLES / "knee.toml"

    def __post_init__(self) -> None:
        self.info: dict[str, Any] = orjson.loads(orjson.dumps(_info(load_rig(self.file))))
        self.name, self.sensors = self.info["rig"], self.info["sensors"]

    @override
    def retained(self) -> dict[str, dict[str, Any]]:
        return super().retained() | {"bridge/info": self.info}

    @property
    @override
    def devices(self) -> dict[str, dict[str, Any]]:
        devices: dict[str, dict[str, Any]] = self.info["devices"]
        return devices

    @override
    def poses(self, seq: int) -> tuple[dict[str, Any], dict[str, Any]]:
        t_us = self.now_us()
        swing = 0.4 * math.sin(2.0 * math.pi * t_us / 1e6 / STEP_S)
        segments, positions = self.info["segments"], {self.info["joints"][0]: [0.0, 0.0, 0.9]}
        angles = {name: 0.0 if i == 0 else swing / i for i, name in enumerate(segments)}
        for name in segments:
            positions |= dict(self._ends(name, positions, angles[name]))

        joints: dict[str, Any] = {
            name: {"p_m": p, "sd_m": 0.01, **self._angles(name, math.degrees(swing))}
            for name, p in positions.items()
        }
        pose = {
            "v": 1, "seq": seq, "t_us": t_us, "mode": "imu", "sync": "locked", "flags": [],
            "segments": {
                name: {"q": about_x(angle), "sd_deg": 1.0, "used": self.sensors[name]}
                for name, angle in angles.items()
            },
            "joints": joints,
        }  # fmt: skip
        return pose, {"v": 1, "t_us": t_us, "segments": {}, "joints": {}}

    def _angles(self, joint: str, degrees: float) -> dict[str, float]:
        names = ANGLES.get(self.info["angles"].get(joint, ""), ())
        return {f"{name}_deg": round(degrees / (i + 1), 2) for i, name in enumerate(names)}

    def _ends(
        self, segment: str, positions: dict[str, list[float]], angle: float
    ) -> Iterator[tuple[str, list[float]]]:
        """Yield the joints at the distal end of a segment, with their positions."""
        joints = self.info["joints"]
        connections: dict[str, Any] = self.info.get("connections") or {}
        down = [0.0, LENGTH_M * math.sin(angle), -LENGTH_M * math.cos(angle)]
        if not connections:
            i = self.info["segments"].index(segment)
            distal, at = [joints[i + 1]], positions[joints[i]]
        else:
            distal = [name for name, joint in connections.items() if joint["parent"] == segment]
            begin = [name for name, joint in connections.items() if joint["child"] == segment]
            at = positions[begin[0] if begin else joints[0]]
        for name in distal:
            side = {"right": 0.1, "left": -0.1}[connections[name]["side"]] if len(distal) > 1 else 0
            offset = [side, 0.0, 0.0] if side else down
            yield name, [a + b for a, b in zip(at, offset, strict=True)]
