"""Real-time scheduler of a scene, which sends each sample at its transmission time.

The scheduler *plans* blocks of 0.2 s: it computes all samples of a block before the block begins.

Transmission times are absolute. Overdue samples are sent at once, in order and with their own time
stamps. After an interruption of more than two seconds, the missed time is skipped.
"""

from __future__ import annotations

import asyncio
import heapq
import time
from typing import TYPE_CHECKING, Protocol

import numpy as np

from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body import InstrumentedSubject
    from jointfit_simulators.scene._optical_stream import OpticalStream
    from jointfit_simulators.scene._streams import ImuStream, SampleCallback
    from jointfit_simulators.scene._truth_log import TruthLog

BLOCK_NS = NS_PER_S // 5
"""Duration of a planned block, ns."""
AHEAD_NS = NS_PER_S // 10
"""Remaining time of a block at which the next block is planned, ns."""
SKIP_NS = 2 * NS_PER_S
"""Duration of an interruption above which the missed time is skipped, ns."""
TRUTH_NS = NS_PER_S // 100
"""Time between two samples of the ground truth, ns."""
_FLUSH_NS = NS_PER_S // 10
"""Time between two writes to the log of the ground truth, ns."""

_AT_ONCE = " at-once"
"""End of the command for a motion that begins without a blend."""


class PlannedStream(Protocol):
    """Stream with planned samples."""

    on_sample: SampleCallback | None
    """Callback for every sent sample."""

    def emit(self, *, sending: bool) -> None:
        """Send the next planned sample, or drop it if not `sending`."""

    def discard(self) -> None:
        """Discard all planned samples."""


class ScenePlayer:
    """Scheduler of all streams of a scene.

    Parameters
    ----------
    subject
        Source of the motion.
    imus
        IMU streams by sensor id; empty for a scene with cameras only.
    optical
        Stream of the camera frames.
    truth
        Log of the ground truth.
    origin_ns
        Host time that corresponds to the subject's time 0, ns.
    sync_line
        Whether each camera exposure produces an edge on the sync line of all sensors.
    """

    def __init__(
        self,
        subject: InstrumentedSubject,
        imus: Mapping[str, ImuStream],
        optical: OpticalStream,
        truth: TruthLog,
        *,
        origin_ns: int,
        sync_line: bool = False,
    ) -> None:
        self._sync_line = sync_line
        self._subject, self._optical, self._truth = subject, optical, truth
        self._imus = [imus[name] for name in subject.sensors] if imus else []
        self._streams: list[PlannedStream] = [*self._imus, optical]
        self._origin_ns = origin_ns
        self._planned_ns = origin_ns
        self._due: list[tuple[int, int]] = []  # heap of transmission time and stream number
        self.paused = False
        """Whether transmission is paused. Samples that are due during the pause are dropped."""
        self.left_out_ns = 0
        """Total time that was skipped after interruptions, ns."""

    def motion(self) -> str:
        """Return the name of the current motion."""
        return self._subject.motion_at((time.monotonic_ns() - self._origin_ns) / NS_PER_S)

    def play(self, words: str) -> None:
        """Start a motion at the next block; raise UnknownMotionError for an unknown name.

        Parameters
        ----------
        words
            Name of the motion. With the word ``at-once`` after it, the motion begins without a
            blend.
        """
        name = words.removesuffix(_AT_ONCE)
        t_s = (self._planned_ns - self._origin_ns) / NS_PER_S
        self._subject.play(name, t_s, at_once=name != words)

    async def run(self) -> None:
        """Send the samples of all streams until cancelled."""
        flushed_ns = 0
        while True:
            now_ns = time.monotonic_ns()
            if now_ns > self._planned_ns + SKIP_NS:
                self.left_out_ns += now_ns - self._planned_ns
                self._planned_ns = now_ns
            if now_ns > self._planned_ns - AHEAD_NS:
                self._plan_block()

            now_ns = time.monotonic_ns()
            while self._due and self._due[0][0] <= now_ns:
                self._streams[heapq.heappop(self._due)[1]].emit(sending=not self.paused)
            if now_ns > flushed_ns + _FLUSH_NS:
                self._truth.advance(now_ns)
                flushed_ns = now_ns

            wake_ns = self._planned_ns - AHEAD_NS
            if self._due:
                wake_ns = min(wake_ns, self._due[0][0])
            await asyncio.sleep(max(0.0, (wake_ns - time.monotonic_ns()) / NS_PER_S))

    def finish(self) -> None:
        """Stop sending, and write the ground truth up to the current time."""
        self.paused = True
        self._due.clear()
        for stream in self._streams:
            stream.discard()
        self._truth.advance(time.monotonic_ns())

    def _plan_block(self) -> None:
        begin_ns, end_ns = self._planned_ns, self._planned_ns + BLOCK_NS

        # Sampling times of all streams
        imu_ns = [imu.plan(begin_ns, end_ns) for imu in self._imus]
        exposures_ns = self._optical.plan(begin_ns, end_ns)
        if self._sync_line:
            for imu in self._imus:
                imu.add_edges(exposures_ns)
        first = -(-begin_ns // TRUTH_NS) * TRUTH_NS
        truth_ns = np.arange(first, end_ns, TRUTH_NS, dtype=np.int64)

        # Observation of the subject at these times
        imu_s = [self._seconds(t_ns) for t_ns in imu_ns]
        imu_s = imu_s or [np.empty(0) for _ in self._subject.sensors]
        truth_s = self._seconds(truth_ns)
        observation = self._subject.observe(imu_s, self._seconds(exposures_ns), truth_s)

        # Measurements and their transmission times
        due_ns = [
            imu.fill(t_s, q)
            for imu, t_s, q in zip(self._imus, imu_s, observation.sensors, strict=bool(self._imus))
        ]
        due_ns.append(self._optical.fill(observation))
        for number, times in enumerate(due_ns):
            for due in times:
                heapq.heappush(self._due, (due, number))

        motions = [self._subject.motion_at(t) for t in truth_s.tolist()]
        self._truth.add(truth_ns, motions, observation.truth, self._optical.cameras.world)
        self._planned_ns = end_ns
        self._subject.discard_before((begin_ns - self._origin_ns) / NS_PER_S)

    def _seconds(self, t_ns: NDArray[np.int64]) -> Array:
        return (t_ns - self._origin_ns) / NS_PER_S
