"""What becomes of a refit while running: taken, kept away or taken back, and how it is told.

Law: a state of its own beside the session's; the session asks it, and owns the calibration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.pipeline.events import FitJob, Notice

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.calibration import CalibrationSettings, Fresh
    from jointfit_daemon.model import Chain
    from jointfit_daemon.pipeline.events import JobFinished
    from jointfit_daemon.pipeline.online_learning._frame_collector import OnlineLearner


class Verdict(NamedTuple):
    """What a refit came to."""

    calibration: Calibration | None
    """To be taken, or None."""
    notice: Notice


@dataclass(slots=True)
class Learned:
    """Refits of one session."""

    job: int | None = None
    """That runs."""
    taught: Calibration | None = None
    """As it was before the first refit that was taken: what can be gone back to."""
    paused: bool = False
    """Nothing is learned until the next functional phase: somebody took it back."""

    def ask(
        self,
        job: int,
        calibration: Calibration,
        chain: Chain,
        settings: CalibrationSettings,
        fresh: Fresh,
    ) -> FitJob:
        """Return the work of a refit."""
        self.job = job
        payload = {"chain": chain, "settings": settings, "fresh": fresh}
        return FitJob(job, "online", payload | {"previous": calibration.to_dict()})

    def finished(self, event: JobFinished, before: Calibration, version: int | None) -> Verdict:
        """Return what came of it."""
        self.job = None
        result: dict[str, Any] = dict(event.result or {})
        failure = event.error or result.get("refused") or (None if result else "no result")
        if failure is not None:
            text = f"nothing learned: {failure}"
            return Verdict(None, Notice(event.t_ns, "calibration", "online", text, "warning"))
        data = _shown(result.get("quality", {}).get("online", {}))
        if "calibration" not in result:
            text = f"nothing learned: {result.get('kept')}"
            return Verdict(None, Notice(event.t_ns, "calibration", "online", text, "info", data))
        self.taught = self.taught or before
        found = Calibration.from_dict(result["calibration"])
        online = {**found.quality["online"], "from_version": version}
        found = replace(found, quality={**found.quality, "online": online})
        text = f"learned from {online['frames']} frames in view of the cameras"
        return Verdict(found, Notice(event.t_ns, "calibration", "online", text, "info", data))

    def health(self, learner: OnlineLearner, now_ns: int) -> dict[str, object]:
        """Return the state of learning, JSON-able: somebody may have stopped it altogether."""
        found = learner.health(now_ns)
        if self.paused and found["state"] != "off":
            why = "taken back by `unlearn`, until the next functional phase"
            return found | {"state": "off", "reason": why, "stopped_s": None}
        return found

    def taken_back(self, calibration: Calibration) -> Calibration | None:
        """Return the calibration with the models it had before; None where nothing was learned."""
        old, self.taught = self.taught, None
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


def _shown(figures: Mapping[str, Any]) -> dict[str, object]:
    """Return what an event tells: degrees, to four digits."""
    shown: dict[str, object] = {key: figures[key] for key in ("frames", "judged") if key in figures}
    for when in ("before", "after"):
        errors = figures.get(f"{when}_rad", {})
        shown[f"{when}_deg"] = {n: float(f"{math.degrees(x):.4g}") for n, x in errors.items()}
    return shown


def models_only(before: Calibration, after: Calibration) -> bool:
    """Tell whether two calibrations differ in models and figures alone."""
    return _but_models(before) == _but_models(after)


def _but_models(one: Calibration) -> Calibration:
    bare = replace(one, segment={}, correlations={}, memory="")
    return replace(bare, quality={}, created_utc="", software="")
