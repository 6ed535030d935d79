"""The pure core: events in, limb states and notices out.

Law: synchronous; no clock, no I/O, no logging, no randomness. The same events in the same order
give the same outputs, byte for byte: that is what makes a recording worth having.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from jointfit_daemon.config import drifting, headings
from jointfit_daemon.fusion import LimbFuser, SensorMonitor
from jointfit_daemon.model import Corrupt, DeviceEvent, ImuSample
from jointfit_daemon.pipeline._frame_grid import FrameGrid
from jointfit_daemon.pipeline._health import health_of
from jointfit_daemon.pipeline._mocap_router import CameraUse
from jointfit_daemon.pipeline._notice_limiter import Bulletin, unix_time_set
from jointfit_daemon.pipeline._sensor_notices import sensor_notices
from jointfit_daemon.pipeline.calibration_session import CalibrationSession
from jointfit_daemon.pipeline.events import (
    CalibrationStored,
    ChunkArrived,
    Configured,
    DeviceInfo,
    DeviceStatus,
    JobFinished,
    Notice,
    Reply,
    Request,
    SourceClosed,
    SourceOpened,
    Tick,
    UnixOffset,
)
from jointfit_daemon.pipeline.online_learning import OnlineLearner, models_only
from jointfit_daemon.pipeline.sources import LagWatch, SourceState, Stamped, SyncLines, known_lags

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import LimbState
    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.timing.alignment import AlignedFrame, FrameAligner
    from jointfit_daemon.timing.clock import Stamp

_CLOSED: dict[str, Literal["info", "warning", "error"]] = {
    "removed": "info",
    "lost": "warning",
    "misconfigured": "error",
}


class Core:
    """Everything between bytes and limb states.

    The first event must be ``Configured``. ``feed`` is called with every event, in order of
    arrival; ``next_deadline_ns`` says when a ``Tick`` is due if nothing else arrives before.
    """

    def __init__(self) -> None:
        self._rig: Rig | None = None
        self._sources: dict[str, SourceState] = {}
        self._lines = SyncLines()
        self._unix_offset_ns: int | None = None
        self._now_ns = 0
        self._seq = 0
        self._empty = 0
        """Frames that no sensor took part in."""
        self._cameras = CameraUse()
        self._bulletin = Bulletin()
        self._session: CalibrationSession
        self._grid: FrameGrid | None = None
        self._aligner: FrameAligner
        self._fuser: LimbFuser
        self._watch: SensorMonitor | None = None
        self._lag_ns: dict[str, int] = {}
        self._lags: LagWatch | None = None
        self._learner: OnlineLearner

    # --- events ------------------------------------------------------------------------------

    def feed(self, event: Event) -> list[Output]:
        """Take one event and return everything it brings about, in order."""
        if isinstance(event, ChunkArrived):  # first: thousands of these to one of the others
            self._now_ns = max(self._now_ns, event.chunk.t_ns)
            return self._chunk(event)
        self._now_ns = max(self._now_ns, event.t_ns)
        if isinstance(event, Tick):
            return self._advance()
        if isinstance(event, UnixOffset):
            return [*self._unix_time(event), *self._advance()]
        return [*self._state_change(event), *self._advance()]

    def _state_change(self, event: Event) -> list[Output]:
        if isinstance(event, Configured):
            return self._configure(event)
        if isinstance(event, SourceOpened):
            return self._opened(event)
        if isinstance(event, SourceClosed):
            return self._closed(event)
        if isinstance(event, Request):
            return self._request(event)
        if isinstance(event, JobFinished):
            return self._job_finished(event)
        return self._session.stored(event) if isinstance(event, CalibrationStored) else []

    @property
    def next_deadline_ns(self) -> int | None:
        """Return when the core wants a ``Tick`` at the latest; None before it is configured."""
        return None if self._rig is None else self._aligner.next_deadline_ns

    def health(self, now_ns: int) -> dict[str, object]:
        """Return counters and clocks of every device: the part of ``bridge/health`` known here."""
        if self._grid is None:
            return {"devices": {}, "frames": {}, "calibration": {}, "learning": {}}
        verdicts = {"mocap": self._cameras.verdicts()} | self._grid.verdicts()
        lags = {} if self._lags is None else self._lags.health()
        return health_of(self._sources, verdicts, self._session, self._fuser, now_ns) | {
            "lags": lags,
            "frames": {
                "sent": self._seq,
                "empty": self._empty,
                "skipped": self._aligner.skipped_frames,
            },
            "learning": self._session.learned.health(self._learner, now_ns),
        }

    # --- configuration -----------------------------------------------------------------------

    def _configure(self, event: Configured) -> list[Output]:
        before, rig = self._rig, event.rig
        self._rig = rig
        kept = {
            source.id: state
            for source in rig.sources
            if (state := self._sources.get(source.id)) is not None and state.source == source
        }
        self._sources = {
            s.id: kept.get(s.id) or SourceState.of(s, self._sources.get(s.id), self._lines)
            for s in rig.sources
        }
        self._tell_unix_offset()
        if all(source.kind != "mocap" for source in rig.sources):
            self._cameras.begin_again()
        outputs: list[Output] = []
        session = _session(event)
        if before is not None:
            outputs += self._session.abort(event.t_ns, "the rig was reloaded")
            outputs.append(Notice(event.t_ns, "reload", rig.name, "configuration reloaded"))
            session.take_over(self._session, same_rig=_worn(before) == _worn(rig))
        if self._grid is None:
            self._grid = FrameGrid(rig, event.t_ns)
        else:
            self._grid.follow(rig)
        self._aligner = self._grid.aligner
        if before is None or before.chain != rig.chain:
            self._watch = SensorMonitor(rig.chain)
        self._session = session
        fuser = None if before is None else self._fuser
        self._use_calibration()
        self._fuser.set_calibration_time(event.t_ns - round(event.calibration_age_s * 1e9))
        if fuser is not None:
            self._fuser.resume(fuser)
        if (doubt := headings(rig.sources)) is not None:
            outputs.append(Notice(event.t_ns, "device", rig.name, doubt, "warning"))
        text = "stored calibration loaded" if event.calibration else "no calibration stored yet"
        return [*outputs, session.status(event.t_ns, text)]

    def _use_calibration(self) -> None:
        rig, calibration = self._rig, self._session.calibration
        if rig is not None:
            self._fuser = LimbFuser(rig.chain, calibration, self._watch, drifting(rig.sources))
            worn = calibration if calibration and calibration.fits(rig.chain) else None
            self._lags = LagWatch(rig.chain, worn, self._lags, known_lags(rig))
            self._session.lags = self._lags
            self._cameras.wear(rig.chain, worn)
            self._lag_ns = dict(calibration.lag_ns) if calibration is not None else {}
            self._lag_ns |= self._lags.known_ns()
            self._learner = OnlineLearner(rig.chain, worn, wanted=rig.calibration.learn_online)

    # --- sources -----------------------------------------------------------------------------

    def _unix_time(self, event: UnixOffset) -> list[Notice]:
        before_ns, self._unix_offset_ns = self._unix_offset_ns, event.offset_ns
        self._tell_unix_offset()
        step_ns = 0 if before_ns is None else event.offset_ns - before_ns
        return unix_time_set(event.t_ns, step_ns) if step_ns else []

    def _tell_unix_offset(self) -> None:
        if self._unix_offset_ns is not None:
            for state in self._sources.values():
                state.clock.feed_unix_offset(self._unix_offset_ns)

    def _opened(self, event: SourceOpened) -> list[Output]:
        state = self._sources.get(event.source)
        if state is None:
            return []
        state.opened()
        return []

    def _closed(self, event: SourceClosed) -> list[Output]:
        state = self._sources.get(event.source)
        notice = Notice(event.t_ns, "device", event.source, event.text, _CLOSED[event.reason])
        if state is None:
            return [notice]

        # A source that is retried and fails as before, without a sample, has nothing new to report.
        repeated = not state.online and event.text == state.closed_text
        state.closed_text = event.text
        notices: list[Output] = [] if repeated else [notice]
        if not state.open:
            return notices

        outputs = self._take(event.source, state, state.closed())
        if state.source.kind == "imu":
            self._aligner.lose(event.source)
        return [*outputs, DeviceStatus(event.source, online=False), *notices]

    def _chunk(self, event: ChunkArrived) -> list[Output]:
        state = self._sources.get(event.source)
        if state is None:
            return []
        outputs = self._take(event.source, state, state.feed(event.chunk))
        # After a stall of the process the other sources' samples are still in the kernel: a
        # deadline ends the waiting at a Tick, which comes after everything readable was read.
        outputs += self._advance(complete_only=True)
        return outputs

    def _take(
        self, source: str, state: SourceState, items: list[Stamped | Corrupt | DeviceEvent]
    ) -> list[Output]:
        outputs: list[Output] = []
        for item in items:
            if not isinstance(item, Stamped):
                outputs += self._told(source, state, item)
                continue
            if state.open and not state.online:  # not by what a closing decoder still gives up
                state.online = True
                outputs.append(DeviceStatus(source, online=True))
                outputs.append(Notice(self._now_ns, "device", source, "streaming"))
            measurement, stamp = item
            if isinstance(measurement, ImuSample):
                outputs += self._imu_sample(source, measurement, stamp)
            else:
                self._mocap_frame(item)
        return outputs

    def _told(self, source: str, state: SourceState, item: Corrupt | DeviceEvent) -> list[Output]:
        if isinstance(item, DeviceEvent) and item.kind == "info":
            return [DeviceInfo(source, state.info)]
        if isinstance(item, DeviceEvent) and item.kind == "restart" and state.source.kind == "imu":
            self._aligner.reset(source)
            said = self._session.restarted(self._now_ns, source)
            return [*self._bulletin.add(self._now_ns, source, item), *said]
        return list(self._bulletin.add(self._now_ns, source, item))

    def _imu_sample(self, source: str, sample: ImuSample, stamp: Stamp) -> list[Output]:
        t_ns, _, synced, epoch, _ = stamp
        q = sample.q_world_sensor
        self._aligner.push(
            source,
            t_ns - self._lag_ns.get(source, 0),
            sample.arrival_ns,
            q,
            synced=synced,
            epoch=epoch,
            rate=sample.rate,
        )
        if self._lags is not None and synced:
            self._lags.add_sample(source, t_ns, q, epoch)
        if self._session.collecting:
            return self._session.add_sample(source, t_ns, q)
        return []

    def _mocap_frame(self, item: Stamped) -> None:
        self._cameras.take(self._now_ns, item, self._session, self._lags, self._learner)

    # --- time --------------------------------------------------------------------------------

    def _advance(self, *, complete_only: bool = False) -> list[Output]:
        if self._rig is None:
            return []
        now_ns = self._now_ns
        frames = self._aligner.advance(now_ns, complete_only=complete_only)
        outputs: list[Output] = [self._fuse(frame) for frame in frames]
        if outputs and self._lags is not None:
            outputs += self._lags.step(now_ns)
        if self._session.collecting:
            outputs += self._session.advance(now_ns)
        elif outputs and self._session.may_learn:
            fresh = self._learner.due(now_ns)
            outputs += [] if fresh is None else self._session.learn(fresh)
            outputs += self._learner.notices(now_ns)
        outputs += self._bulletin.due(now_ns)
        if news := self._fuser.pop_reports(now_ns):
            outputs += sensor_notices(now_ns, news)
        return outputs

    def _fuse(self, frame: AlignedFrame) -> LimbState:
        self._seq += 1
        self._empty += not frame.orientations
        fresh = self._cameras.fresh(self._now_ns)
        state = self._fuser.fuse(
            frame.t_ns,
            frame.completed_ns,
            self._seq,
            frame.orientations,
            extrapolated=frame.extrapolated,
            optical_origin=self._cameras.origin if fresh else None,
            sync="locked" if frame.synced else "settling",
            mode="imu+mocap" if fresh else "imu",
        )
        self._learner.add_frame(frame, state.flags)
        return state

    # --- calibration -------------------------------------------------------------------------

    def _request(self, event: Request) -> list[Output]:
        if event.command == "calibrate":
            before = self._session.calibration
            outputs = self._session.request(event)
            self._took(before)
            return outputs
        message = f"unknown request {event.command!r}; known: calibrate"
        error = {"key": "command", "message": message}
        return [Reply(event.command, event.transaction, "error", {}, error)]

    def _job_finished(self, event: JobFinished) -> list[Output]:
        before = self._session.calibration
        outputs = self._session.job_finished(event)
        self._took(before)
        return outputs

    def _took(self, before: Calibration | None) -> None:
        """Go on with what is in force now, if it is another."""
        after = self._session.calibration
        if before and after and after is not before and models_only(before, after):
            self._fuser.replace_models(after)
        elif after is not before:
            self._use_calibration()


def _session(event: Configured) -> CalibrationSession:
    rig = event.rig
    return CalibrationSession(
        rig.chain,
        rig.calibration,
        mocap=any(source.kind == "mocap" for source in rig.sources),
        calibration=event.calibration,
        version=event.calibration_version,
    )


def _worn(rig: Rig) -> tuple[object, ...]:
    """Return all that a pose or an alignment taken before a reload depends on."""
    return rig.chain, rig.calibration, rig.sources
