"""Stream of camera frames: planned in blocks, sent one by one.

The optical world is z up here; the server converts to its own axes.

Invariant: a frame carries its exposure time, even if it is sent late.
"""

from __future__ import annotations

from collections import deque
from math import isfinite
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from jointfit_simulators.devices import NS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from jointfit_simulators.body import Observation
    from jointfit_simulators.devices import CameraFrames, Cameras, SampleTiming
    from jointfit_simulators.scene._streams import SampleCallback
    from jointfit_simulators.settings import Knobs

Vector = tuple[float, float, float]
Pose = tuple[Vector, tuple[float, float, float, float]]


class OpticalServer(Protocol):
    """Server that sends camera frames."""

    number: int
    """Of the next frame."""

    @property
    def sent(self) -> int:
        """Frames put on the wire so far."""

    def push(
        self,
        exposure_host_ns: int,
        markers: Mapping[str, Vector | None],
        bodies: Mapping[str, Pose | None],
    ) -> None:
        """Send one frame now; None marks an occluded marker or body."""


class OpticalStream:
    """Cameras of a scene and the server that streams their frames.

    Parameters
    ----------
    knobs
        Camera rate.
    cameras
        Source of the frames.
    ticker
        Exposure times and the server's clock.
    server
        Receiver of the frames; None without an optical system.
    told
        Called for every frame sent, with the id ``mocap``.
    """

    def __init__(
        self,
        knobs: Knobs,
        cameras: Cameras,
        ticker: SampleTiming,
        server: OpticalServer | None,
        told: SampleCallback | None = None,
    ) -> None:
        self.cameras = cameras
        self._told = told
        self._server = server
        self._ticker = ticker
        self._period_ns = NS / knobs.mocap_hz
        self._waiting: deque[tuple[int, dict[str, Vector | None], dict[str, Pose | None]]] = deque()
        self.running = server is not None
        """Whether frames are sent; the cameras continue to expose."""

    @property
    def sent(self) -> int:
        """Number of frames sent; zero without a client."""
        return self._server.sent if self._server else 0

    def plan(self, begin_ns: int, end_ns: int) -> NDArray[np.int64]:
        """Plan the exposures of a block and return their true host times, ns."""
        if self._server is None:
            return np.empty(0, dtype=np.int64)
        self._taken = self._ticker.samples(begin_ns, end_ns, self._period_ns)
        return self._taken.host_ns

    def fill(self, observation: Observation) -> list[int]:
        """Add markers to the planned frames and return the transmission times, ns."""
        if self._server is None:
            return []
        seen = self.cameras.capture(observation)
        for i, exposure in enumerate(self._taken.host_ns.tolist()):
            self._waiting.append((exposure, self._markers(seen, i), self._bodies(seen, i)))
        return cast("list[int]", self._taken.due_ns.tolist())

    def _markers(self, seen: CameraFrames, i: int) -> dict[str, Vector | None]:
        return {
            name: cast("Vector", tuple(at)) if isfinite(at[0]) else None
            for name, at in zip(self.cameras.markers, seen.markers[i].tolist(), strict=True)
        }

    def _bodies(self, seen: CameraFrames, i: int) -> dict[str, Pose | None]:
        places, turns = seen.body_positions[i].tolist(), seen.body_orientations[i].tolist()
        return {
            name: cast("Pose", (tuple(at), tuple(q))) if isfinite(at[0]) else None
            for name, at, q in zip(self.cameras.bodies, places, turns, strict=True)
        }

    def emit(self, *, heard: bool = True) -> None:
        """Send the next frame, or drop it if the stream is stopped."""
        frame = self._waiting.popleft()
        if heard and self.running and self._server is not None:
            before, number = self._server.sent, self._server.number
            self._server.push(*frame)
            if self._told is not None and self._server.sent > before:
                self._told("mocap", number, frame[0])

    def forget(self) -> None:
        """Drop the frames that are planned but not sent."""
        self._waiting.clear()
