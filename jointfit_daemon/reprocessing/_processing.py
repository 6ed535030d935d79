"""Processing of recorded events in a new core, with optional changes of rig, calibration or fits.

Invariant: without changes, the core receives exactly the recorded events, so its outputs equal the
outputs of the daemon, byte for byte. With changes, the core receives none of the recorded results
of fits. The fits are computed again, or omitted if the changes contain a calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import orjson

from jointfit_daemon.calibration import FitResult
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    CalibrationSelected,
    CalibrationStored,
    CancelJob,
    ChunkArrived,
    Configured,
    FitJob,
    JobFinished,
    JobProgress,
    Request,
    SourceClosed,
    SourceOpened,
)
from jointfit_daemon.reprocessing._errors import ReprocessingError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.events import Event, Output

_OF_A_SOURCE = (ChunkArrived, SourceOpened, SourceClosed)
_FIT_EVENTS = (JobFinished, JobProgress, CalibrationStored)
"""Types of events that contain results of fits."""


@dataclass(frozen=True, slots=True)
class Changes:
    """Changes relative to the recorded run; there are none by default."""

    rig: Rig | None = None
    """Rig that replaces the recorded rigs; None to use the recorded rigs."""
    calibration: Calibration | None = None
    """Calibration to use from the first to the last event; None to use the recorded
    calibrations."""
    compute_fits: bool = False
    """Whether fits are computed again even if nothing else changes."""

    @property
    def any(self) -> bool:
        """Whether the outputs may differ from the recorded outputs."""
        return self.rig is not None or self.calibration is not None or self.compute_fits


def process_events(
    events: Iterable[Event], changes: Changes | None = None, core: Core | None = None
) -> Iterator[tuple[Event, list[Output]]]:
    """Yield each event that a core processes, together with its outputs, in order.

    Parameters
    ----------
    events
        Events of a recording.
    changes
        Changes relative to the recorded run; None for no change.
    core
        A new core. By default, the function creates one.

    Raises
    ------
    ReprocessingError
        The first event is not a configuration, or `changes` contains a rig or calibration that does
        not fit the recording.
    """
    core = core or Core()
    changed = None if changes is None or not changes.any else _ChangedRun(core, changes)
    configured = False
    for event in events:
        if not configured:
            if not isinstance(event, Configured):
                raise ReprocessingError(
                    "the recording does not begin with a configuration: its beginning is missing. "
                    "Add the first part of the session"
                )
            configured = True
        if changed is None:
            yield event, core.feed(event)
        else:
            yield from changed.feed(event)
    if changed is not None:
        yield from changed.finish()


class _ChangedRun:
    """Processes events with the changes in a core, and computes the fits in this process.

    With another rig, the result of a fit is delivered at the instant at which the fit was
    requested. With the recorded rig, the result is delivered at the instant of the recorded result,
    so that the order of all inputs is unchanged.
    """

    def __init__(self, core: Core, changes: Changes) -> None:
        self._core, self._changes = core, changes
        self._sources: frozenset[str] | None = None
        """Sources of the rig that is used; None before the first configuration."""
        self._in_force: Calibration | None = None
        self._waiting: FitJob | None = None
        self._now_ns = 0

    def feed(self, event: Event) -> Iterator[tuple[Event, list[Output]]]:
        """Process one recorded event, or an event that replaces it."""
        if isinstance(event, _OF_A_SOURCE):
            if self._sources is not None and event.source in self._sources:
                yield from self._pass_on(event)
        elif isinstance(event, Configured):
            if (configured := self._configuration(event)) is not None:
                yield from self._pass_on(configured)
        elif isinstance(event, _FIT_EVENTS):
            waiting = self._waiting
            if isinstance(event, JobFinished) and waiting is not None and waiting.job == event.job:
                yield from self._finish_job(waiting, event.t_ns)
        else:
            # A given calibration must stay in use. Requests for a fit or for another calibration
            # are therefore omitted.
            requested = isinstance(event, Request) and event.command != "mark"
            other = requested or isinstance(event, CalibrationSelected)
            if self._changes.calibration is None or not other:
                yield from self._pass_on(event)

    def finish(self) -> Iterator[tuple[Event, list[Output]]]:
        """Deliver the result of a fit that was still running at the end of the recorded run."""
        if self._waiting is not None:
            yield from self._finish_job(self._waiting, self._now_ns)

    def _configuration(self, event: Configured) -> Configured | None:
        """Return the configuration that replaces a recorded one; None to keep the previous one."""
        changes, first = self._changes, self._sources is None
        rig = event.rig if changes.rig is None else changes.rig
        if not first and changes.rig is not None:
            return None
        if first and changes.rig is not None:
            check_sources(event.rig, changes.rig)
        self._sources = frozenset(source.id for source in rig.sources)

        if changes.calibration is not None:
            check_calibration(changes.calibration, rig)
            self._in_force = changes.calibration
            return replace(
                event, rig=rig, calibration=changes.calibration, calibration_version=None,
                calibration_age_s=0.0,
            )  # fmt: skip
        if first:
            recorded = event.calibration
            self._in_force = recorded if recorded and recorded.fits(rig.chain) else None
            version = event.calibration_version if self._in_force else None
            return replace(event, rig=rig, calibration=self._in_force, calibration_version=version)
        if self._in_force is not None and not self._in_force.fits(rig.chain):
            self._in_force = event.calibration  # the reload changed the limb
        return replace(event, calibration=self._in_force, calibration_version=None)

    def _pass_on(self, event: Event) -> Iterator[tuple[Event, list[Output]]]:
        self._now_ns = event.chunk.t_ns if isinstance(event, ChunkArrived) else event.t_ns
        outputs = self._core.feed(event)
        yield event, outputs
        for output in outputs:
            if isinstance(output, CalibrationReady):
                self._in_force = output.calibration
            elif isinstance(output, CancelJob):
                self._waiting = None
            elif isinstance(output, FitJob) and self._changes.calibration is None:
                if self._changes.rig is not None:
                    yield from self._finish_job(output, self._now_ns)
                else:
                    # The daemon has one worker, and a new job replaces the waiting job.
                    self._waiting = output

    def _finish_job(self, job: FitJob, t_ns: int) -> Iterator[tuple[Event, list[Output]]]:
        self._waiting = None
        yield from self._pass_on(JobFinished(t_ns, job.job, compute_fit(job), None))


def compute_fit(job: FitJob) -> FitResult:
    """Compute a fit in this process and return its result.

    The result passes through JSON, as the result of a worker does.
    """
    from jointfit_daemon.calibration.phases import run_job  # noqa: PLC0415 - loads scipy

    text = orjson.dumps(run_job(job.work).to_dict(), option=orjson.OPT_SERIALIZE_NUMPY)
    return FitResult.from_dict(orjson.loads(text))


def check_sources(recorded: Rig, wanted: Rig) -> None:
    """Check that the recording contains every source of `wanted`, with the same driver.

    Raises
    ------
    ReprocessingError
        A source is missing, or its bytes were recorded with a different driver.
    """
    drivers = {source.id: source.driver for source in recorded.sources}
    known = ", ".join(f"{name} ({driver})" for name, driver in drivers.items())
    for source in wanted.sources:
        if source.id not in drivers:
            raise ReprocessingError(
                f"the recording contains no source {source.id!r}, expected one of: {known}. "
                "Use the recorded id in the rig, or remove the device from it"
            )
        if source.driver != drivers[source.id]:
            raise ReprocessingError(
                f"source {source.id!r}: recorded with driver {drivers[source.id]!r}, but the rig "
                f"names {source.driver!r}, which cannot read these bytes: use the recorded driver"
            )


def check_calibration(calibration: Calibration, rig: Rig) -> None:
    """Check that a calibration belongs to the limb and the sensors of a rig.

    Raises
    ------
    ReprocessingError
        The calibration belongs to another limb or to other sensors.
    """
    if not calibration.fits(rig.chain):
        sensors = ", ".join(calibration.sensor)
        expected = ", ".join(name for group in rig.chain.sensors for name in group)
        raise ReprocessingError(
            f"the calibration belongs to another limb or other sensors ({sensors}) than the rig "
            f"({expected}): choose the calibration of this rig"
        )
