"""Distribution of mocap frames to their consumers.

The consumers are the calibration, the lag monitor, online learning, and the computation of O1, the
center of the first joint.

Invariant: every frame is counted once, as used or idle. Only live frames are used, not frames of a
recording that the camera server plays back. The calibration, the lag monitor and online learning
receive a frame only if its stamp is synchronized to the host clock. O1 needs no synchronization.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.fusion import OpticalOrigin
from jointfit_daemon.model import ImuSample

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, MocapFrame, Vector
    from jointfit_daemon.pipeline.calibration_session import CalibrationSession
    from jointfit_daemon.pipeline.online_learning import OnlineFrameCollector
    from jointfit_daemon.pipeline.sources import LagMonitor, StampedMeasurement

FRESH_NS = 200_000_000
"""Largest age of the last live frame at which the fusion mode is ``imu+mocap``, ns."""


class MocapRouter:
    """Distributes the mocap frames of one rig and counts them."""

    def __init__(self) -> None:
        self._live_ns: int | None = None
        self._used = self._idle = 0
        self._locator: OpticalOrigin | None = None
        self._origin: Vector | None = None
        self._unlocated: MocapFrame | None = None
        """Last frame, which is stored until O1 is requested. O1 is computed on request, because the
        rate of the cameras may exceed the rate of the limb states."""

    @property
    def origin(self) -> Vector | None:
        """Position of O1 in the last frame, optical world, m; None if it is not visible."""
        if self._unlocated is not None and self._locator is not None:
            self._origin, self._unlocated = self._locator.locate(self._unlocated), None
        return self._origin

    def reset_counts(self) -> None:
        """Set the counts to 0, because the rig no longer has a mocap source."""
        self._used = self._idle = 0

    def set_calibration(self, chain: Chain, calibration: Calibration | None) -> None:
        """Locate O1 by the markers of `calibration`. Without a calibration, O1 is not located."""
        self._locator = OpticalOrigin(chain, calibration) if calibration else None
        self._origin = self._unlocated = None

    def is_fresh(self, now_ns: int) -> bool:
        """Return whether a live frame arrived within the last 200 ms."""
        return self._live_ns is not None and now_ns - self._live_ns < FRESH_NS

    def counts(self) -> dict[str, int]:
        """Return the numbers of used and idle frames."""
        return {"used": self._used, "idle": self._idle}

    def add(
        self,
        now_ns: int,
        item: StampedMeasurement,
        session: CalibrationSession,
        lags: LagMonitor | None,
        collector: OnlineFrameCollector,
    ) -> None:
        """Pass one frame to all consumers."""
        frame, stamp, used = item.measurement, item.stamp, False
        if isinstance(frame, ImuSample):
            return

        if frame.live:
            self._live_ns = now_ns
            if lags is not None and stamp.synced:
                lags.add_mocap(stamp.t_ns, frame, stamp.epoch)
                collector.add_mocap(stamp.t_ns, frame, stamp.epoch)
            if session.collecting and stamp.synced:
                used = True
                session.add_mocap(stamp.t_ns, frame)
            if self._locator is not None:
                used = True
                self._unlocated = frame
        if used:
            self._used += 1
        else:
            self._idle += 1
