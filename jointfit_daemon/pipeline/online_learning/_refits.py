"""Refits of the models during operation: request, result and reversion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel
from jointfit_daemon.pipeline.health import LearningHealth, LearningState

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.events import JobFinished
    from jointfit_daemon.pipeline.online_learning._frame_collector import OnlineFrameCollector


class RefitOutcome(NamedTuple):
    """Result of a refit."""

    calibration: Calibration | None
    """Calibration with the new models; None if they are rejected."""
    notice: Notice


@dataclass(slots=True)
class OnlineRefits:
    """Tracks the refits since the last functional calibration."""

    job: int | None = None
    """Number of the running refit."""
    original: Calibration | None = None
    """Calibration before the first accepted refit. A reversion restores this calibration."""
    paused: bool = False
    """Whether online learning is paused until the next functional calibration. A reversion or the
    selection of a stored calibration pauses it."""

    def finish(self, event: JobFinished, before: Calibration, version: int | None) -> RefitOutcome:
        """Return the outcome of the running refit.

        `before` is the current calibration, and `version` its number in the store.
        """
        self.job = None
        result, kind = event.result, NoticeKind.CALIBRATION
        if result is None or event.failure is not None:
            text = f"models unchanged: {event.failure}"
            return RefitOutcome(None, Notice(event.t_ns, kind, "online", text, NoticeLevel.WARNING))

        # The notice states errors in degrees with four digits.
        quality = result.quality.get("online", {})
        data: dict[str, object] = {
            key: quality[key] for key in ("frames", "judged") if key in quality
        }
        for when in ("before", "after"):
            errors = quality.get(f"{when}_rad", {})
            data[f"{when}_deg"] = {n: float(f"{math.degrees(x):.4g}") for n, x in errors.items()}
        info = NoticeLevel.INFO
        if (found := result.calibration) is None:
            text = f"models unchanged: {result.kept}"
            return RefitOutcome(None, Notice(event.t_ns, kind, "online", text, info, data))

        self.original = self.original or before
        online = {**found.quality["online"], "from_version": version}
        found = replace(found, quality={**found.quality, "online": online})
        text = f"models refitted with {online['frames']} frames of sensors and mocap"
        return RefitOutcome(found, Notice(event.t_ns, kind, "online", text, info, data))

    def health(self, collector: OnlineFrameCollector, now_ns: int) -> LearningHealth:
        """Return the state of online learning."""
        found = collector.health(now_ns)
        if self.paused and found.state != LearningState.OFF:
            reason = "paused by a request until the next functional calibration"
            return LearningHealth(LearningState.OFF, reason, kept=found.kept)
        return found

    def revert(self, calibration: Calibration) -> Calibration | None:
        """Return the calibration with its original models; None without an accepted refit."""
        old, self.original = self.original, None
        if old is None:
            return None

        self.paused = True
        quality = {key: value for key, value in calibration.quality.items() if key != "online"}
        if "online" in old.quality:
            quality["online"] = old.quality["online"]
        segments = {
            name: replace(item, models=old.segment[name].models)
            for name, item in calibration.segment.items()
        }
        return replace(
            calibration,
            segment=segments,
            correlations=old.correlations,
            memory=old.memory,
            quality=quality,
        )


def only_models_differ(before: Calibration, after: Calibration) -> bool:
    """Return whether two calibrations are equal except for models and quality."""
    return _without_models(before) == _without_models(after)


def _without_models(calibration: Calibration) -> Calibration:
    bare = replace(calibration, segment={}, correlations={}, memory="")
    return replace(bare, quality={}, created_utc="", software="")
