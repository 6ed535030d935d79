"""A fake sensor that is rotated as the physical test requires; each chunk is a quaternion."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from pydantic import BaseModel
from scipy.spatial.transform import Rotation, Slerp

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.model import Chunk, Decoded, ImuSample, Quaternion

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.config import Source

PERIOD_S, REST_S, TURN_S = 0.02, 1.5, 0.5


class TurnedSettings(BaseModel):
    """Settings of the sensor in rig.toml."""

    direction: Literal["sensor_to_world", "world_to_sensor"] = "sensor_to_world"


class TurnedDecoder:
    """Decodes four floats of 64 bit, w x y z."""

    messages = discarded_bytes = 0
    tick_clock = None

    def __init__(self, settings: TurnedSettings) -> None:
        self._inverse = settings.direction == "world_to_sensor"

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return one sample for each chunk."""
        native = np.frombuffer(chunk.data)
        q = rotation.conjugate(native) if self._inverse else native
        return [ImuSample(chunk.t_ns, _tuple(q), _tuple(native), None, None)]

    def flush(self) -> list[Decoded]:
        """Return nothing, because nothing is pending."""
        return []


class TurnedSensor:
    """Driver of the sensor."""

    def __init__(self, settings: TurnedSettings) -> None:
        self._settings = settings

    def decoder(self) -> TurnedDecoder:
        """Return a new decoder."""
        return TurnedDecoder(self._settings)


def turned_source(direction: str = "sensor_to_world") -> Source:
    """Return the sensor S1 of a rig with the setting `direction`."""
    settings = TurnedSettings.model_validate({"direction": direction})
    return cast("Source", SimpleNamespace(id="S1", driver_class=TurnedSensor, settings=settings))


def guided_poses() -> list[Rotation]:
    """Return the four poses of a test that follows the instructions."""
    flat = Rotation.from_euler("z", 40, degrees=True)
    quarter = Rotation.from_euler("z", 90, degrees=True)
    tipped = quarter * flat * Rotation.from_euler("x", 90, degrees=True)
    return [flat, quarter * flat, tipped, quarter * tipped]


def guided_chunks(poses: list[Rotation] | None = None) -> Iterator[Chunk]:
    """Yield the chunks of a sensor that rests in each pose; the quaternions are sensor to world."""
    poses = guided_poses() if poses is None else poses
    times = [0.0]
    for _ in poses:
        times += [times[-1] + REST_S, times[-1] + REST_S + TURN_S]
    ends = [pose for pose in poses for _ in range(2)]
    path = Slerp(times[: len(ends)], Rotation.concatenate(ends))
    for t_s in np.arange(0.0, times[len(ends) - 1], PERIOD_S):
        x, y, z, w = path(t_s).as_quat()
        yield Chunk(int(t_s * 1e9), np.array((w, x, y, z)).tobytes())


def _tuple(q: Any) -> Quaternion:
    w, x, y, z = q.tolist()
    return (w, x, y, z)
