"""What camera frames are used for while it runs: calibration, lags, learning, and where O1 is.

Law: every frame is counted once, used or idle. Only live ones are looked at, and only those whose
stamp is mapped to the host's clock are paired with sensors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.fusion import OpticalOrigin
from jointfit_daemon.model import ImuSample

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, Vector
    from jointfit_daemon.pipeline.calibration_session import CalibrationSession
    from jointfit_daemon.pipeline.online_learning import OnlineLearner
    from jointfit_daemon.pipeline.sources import LagWatch, Stamped

FRESH_NS = 200_000_000
"""A rig whose cameras gave a live frame within this time runs in mode ``imu+mocap``."""


class CameraUse:
    """Takes the frames of one rig's cameras."""

    def __init__(self) -> None:
        self._seen_ns: int | None = None
        self._used = self._idle = 0
        self._locator: OpticalOrigin | None = None
        self.origin: Vector | None = None
        """O1 in the frame before, optical world, m; None where it was not seen."""

    def begin_again(self) -> None:
        """Forget the counts: the rig has no cameras any more."""
        self._used = self._idle = 0

    def wear(self, chain: Chain, calibration: Calibration | None) -> None:
        """Look for O1 as this calibration has it, or not at all."""
        self._locator = OpticalOrigin(chain, calibration) if calibration else None
        self.origin = None

    def fresh(self, now_ns: int) -> bool:
        """Tell whether the cameras gave a live frame a moment ago."""
        return self._seen_ns is not None and now_ns - self._seen_ns < FRESH_NS

    def verdicts(self) -> dict[str, int]:
        """Return how many frames were of use, and how many nobody needed."""
        return {"used": self._used, "idle": self._idle}

    def take(
        self,
        now_ns: int,
        item: Stamped,
        session: CalibrationSession,
        lags: LagWatch | None,
        learner: OnlineLearner,
    ) -> None:
        """Take one frame and give it to all who want it."""
        frame, stamp, used = item.measurement, item.stamp, False
        if isinstance(frame, ImuSample):
            return
        if frame.live:
            self._seen_ns = now_ns
            if lags is not None and stamp.synced:
                lags.add_mocap(stamp.t_ns, frame, stamp.epoch)
                learner.add_mocap(stamp.t_ns, frame, stamp.epoch)
            if session.collecting:
                used = True
                session.add_mocap(stamp.t_ns, frame)
            if self._locator is not None:
                used = True
                self.origin = self._locator.locate(frame)
        if used:
            self._used += 1
        else:
            self._idle += 1
