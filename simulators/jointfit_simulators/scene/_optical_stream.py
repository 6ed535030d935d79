"""Stream of camera frames, which are planned in blocks (computed in advance) and sent one by one.

The optical world has z up in this module. The server converts the frames to its own axes.

Invariant: a frame contains its exposure time, even if it is sent late.
"""

from __future__ import annotations

from collections import deque
from math import isfinite
from typing import TYPE_CHECKING, cast

import numpy as np

from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_simulators.body import Observation
    from jointfit_simulators.devices import Bodies, Cameras, Markers, Pose, SampleTiming, Vector
    from jointfit_simulators.scene._mocap_families import MocapServer
    from jointfit_simulators.scene._streams import SampleCallback
    from jointfit_simulators.settings import Knobs


class OpticalStream:
    """Cameras of a scene and the server that streams their frames.

    Parameters
    ----------
    knobs
        Settings with the camera rate.
    cameras
        Source of the frames.
    timing
        Exposure times, and clock of the server.
    server
        Server that sends the frames; None without an optical system.
    """

    def __init__(
        self, knobs: Knobs, cameras: Cameras, timing: SampleTiming, server: MocapServer | None
    ) -> None:
        self.cameras = cameras
        self.on_sample: SampleCallback | None = None
        """Callback for every sent frame, with the id ``mocap``."""
        self._server = server
        self._timing = timing
        self._period_ns = NS_PER_S / knobs.mocap_hz
        self._planned: deque[tuple[int, Markers, Bodies]] = deque()
        self.running = server is not None
        """Whether frames are sent. The cameras expose frames in any case."""

    @property
    def sent(self) -> int:
        """Number of sent frames; 0 without a client."""
        return self._server.sent if self._server else 0

    def plan(self, begin_ns: int, end_ns: int) -> NDArray[np.int64]:
        """Plan the exposures of a block; return their true host times, ns."""
        if self._server is None:
            return np.empty(0, dtype=np.int64)
        self._block = self._timing.samples(begin_ns, end_ns, self._period_ns)
        return self._block.host_ns

    def fill(self, observation: Observation) -> list[int]:
        """Add markers and rigid bodies to the planned frames; return the transmission times, ns."""
        if self._server is None:
            return []
        frames = self.cameras.capture(observation)
        for exposure_ns, positions, origins, turns in zip(
            self._block.host_ns.tolist(), frames.markers.tolist(),
            frames.body_positions.tolist(), frames.body_orientations.tolist(), strict=True,
        ):  # fmt: skip
            markers = {
                name: cast("Vector", tuple(at)) if isfinite(at[0]) else None
                for name, at in zip(self.cameras.markers, positions, strict=True)
            }
            bodies = {
                name: cast("Pose", (tuple(at), tuple(q))) if isfinite(at[0]) else None
                for name, at, q in zip(self.cameras.bodies, origins, turns, strict=True)
            }
            self._planned.append((exposure_ns, markers, bodies))
        return cast("list[int]", self._block.due_ns.tolist())

    def emit(self, *, sending: bool = True) -> None:
        """Send the next frame, or drop it if the stream is stopped."""
        frame = self._planned.popleft()
        if sending and self.running and self._server is not None:
            before, number = self._server.sent, self._server.number
            self._server.push(*frame)
            if self.on_sample is not None and self._server.sent > before:
                self.on_sample("mocap", number, frame[0])

    def discard(self) -> None:
        """Discard the planned frames that are not yet sent."""
        self._planned.clear()
