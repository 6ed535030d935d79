"""From poses to camera frames on a wire, planned in blocks and sent one by one.

Law: a frame is stamped with its exposure, however late it leaves. The optical world is z up here;
the server turns it to what its wire has.
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
    from jointfit_simulators.devices import CameraFrames, Cameras, Ticker
    from jointfit_simulators.scene._streams import SampleTold
    from jointfit_simulators.settings import Knobs

Vector = tuple[float, float, float]
Pose = tuple[Vector, tuple[float, float, float, float]]


class OpticalServer(Protocol):
    """What sends camera frames."""

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
        """Send one frame now; None is hidden."""


class OpticalStream:
    """The cameras of a scene and the server that streams what they see.

    Parameters
    ----------
    knobs
        Camera rate.
    cameras
        What is seen.
    ticker
        When they expose, by the server's clock.
    server
        Where frames go; None: no optical system.
    told
        Told of every frame sent, as `mocap`.
    """

    def __init__(
        self,
        knobs: Knobs,
        cameras: Cameras,
        ticker: Ticker,
        server: OpticalServer | None,
        told: SampleTold | None = None,
    ) -> None:
        self.cameras = cameras
        self._told = told
        self._server = server
        self._ticker = ticker
        self._period_ns = NS / knobs.mocap_hz
        self._waiting: deque[tuple[int, dict[str, Vector | None], dict[str, Pose | None]]] = deque()
        self.running = server is not None
        """Whether frames are sent; the cameras see on meanwhile."""

    @property
    def sent(self) -> int:
        """Frames put on the wire so far; without a client none are."""
        return self._server.sent if self._server else 0

    def plan(self, begin_ns: int, end_ns: int) -> NDArray[np.int64]:
        """Expose the frames of a block; return their true host instants."""
        if self._server is None:
            return np.empty(0, dtype=np.int64)
        self._taken = self._ticker.samples(begin_ns, end_ns, self._period_ns)
        return self._taken.host_ns

    def fill(self, observation: Observation) -> list[int]:
        """Give the planned frames their markers; return when each is due on the wire."""
        if self._server is None:
            return []
        seen = self.cameras.see(observation)
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
        """Send the next frame, or drop it where nobody is to hear it."""
        frame = self._waiting.popleft()
        if heard and self.running and self._server is not None:
            before, number = self._server.sent, self._server.number
            self._server.push(*frame)
            if self._told is not None and self._server.sent > before:
                self._told("mocap", number, frame[0])

    def forget(self) -> None:
        """Drop what is planned and not sent."""
        self._waiting.clear()
