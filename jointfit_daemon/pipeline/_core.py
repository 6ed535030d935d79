"""The core, which converts input events to limb states, notices and calibration jobs.

Input events are, for example, bytes from a device, requests, and the passage of time (`events`). A
notice is a message about a change, such as a lost sensor.

Invariant: the core is synchronous and deterministic, without clock, I/O, logging or randomness. The
same events in the same order yield the same outputs, byte for byte, so a recording can be replayed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import drifting_imus, heading_warning
from jointfit_daemon.fusion import LimbFuser, SensorMonitor, sensor_states
from jointfit_daemon.model import Corrupt, DeviceEvent, FusionMode, ImuSample, SyncState
from jointfit_daemon.pipeline._frame_grid import FrameGrid
from jointfit_daemon.pipeline._marks import mark_outputs
from jointfit_daemon.pipeline._mocap_router import MocapRouter
from jointfit_daemon.pipeline._moving_centers import MovingCenters
from jointfit_daemon.pipeline._notice_limiter import NoticeLimiter, unix_step_notices
from jointfit_daemon.pipeline._optical_comparison import OpticalComparison
from jointfit_daemon.pipeline._optical_trackers import (
    chain_tracker,
    label_monitor,
    planar_tracker,
    unused_refinement,
)
from jointfit_daemon.pipeline.calibration_session import CalibrationSession
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationSelected,
    CalibrationStored,
    ChunkArrived,
    Configured,
    DeviceInfo,
    DeviceStatus,
    JobFinished,
    JobProgress,
    Notice,
    NoticeKind,
    NoticeLevel,
    Request,
    SourceClosed,
    SourceOpened,
    Tick,
    UnixOffset,
)
from jointfit_daemon.pipeline.health import CoreHealth, FrameCounts
from jointfit_daemon.pipeline.online_learning import OnlineFrameCollector, only_models_differ
from jointfit_daemon.pipeline.sources import (
    LagMonitor,
    SourceState,
    StampedMeasurement,
    SyncLines,
    known_lags,
)
from jointfit_daemon.timing.alignment import RateDivider

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import LimbState, MocapFrame
    from jointfit_daemon.pipeline._label_monitor import LabelMonitor
    from jointfit_daemon.pipeline.chain_tracking import ChainTracker
    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.pipeline.planar_chain import PlanarTracker
    from jointfit_daemon.pipeline.stage_observer import StageObserver
    from jointfit_daemon.timing.alignment import AlignedFrame, FrameAligner
    from jointfit_daemon.timing.clock import Stamp

_CLOSED_LEVELS = {
    "removed": NoticeLevel.INFO,
    "lost": NoticeLevel.WARNING,
    "misconfigured": NoticeLevel.ERROR,
}


class Core:
    """Processes input events.

    The first event must be ``Configured``. Call ``feed`` with every event in the order of arrival.
    If no event arrives before ``next_deadline_ns``, call ``feed`` with a ``Tick`` at that time.

    Parameters
    ----------
    observe
        Function that is called for each measurement, in the order of processing, when the instant
        of the measurement is known. The arguments are the id of the source and the measurement. It
        must not change the measurement.
    """

    def __init__(self, observe: Callable[[str, StampedMeasurement], None] | None = None) -> None:
        self._observe = observe
        self.stages: StageObserver | None = None
        """Observer of the processing stages of every frame."""
        self._rig: Rig | None = None
        self._sources: dict[str, SourceState] = {}
        self._lines = SyncLines()
        self._unix_offset_ns: int | None = None
        self._now_ns = 0
        self._seq = 0
        self._empty = 0
        """Number of frames to which no sensor contributed."""
        self._marks = 0
        self._mocap = MocapRouter()
        self._limiter = NoticeLimiter()
        self._session: CalibrationSession
        self._grid: FrameGrid | None = None
        self._aligner: FrameAligner
        self._fuser: LimbFuser
        self._sensor_monitor: SensorMonitor | None = None
        self._lag_ns: dict[str, int] = {}
        self._lags: LagMonitor | None = None
        self._collector: OnlineFrameCollector
        self._comparison: OpticalComparison
        self._usable: Calibration | None = None
        """The current calibration; None if it does not fit the rig's chain."""
        self._sensors_rate: RateDivider | None = None
        self._moving_centers: MovingCenters | None = None
        self._chain_tracker: ChainTracker | None = None
        self._label_monitor: LabelMonitor | None = None
        self._planar_tracker: PlanarTracker | None = None
        self._handlers: dict[type, Callable[[Any], list[Output]]] = {
            Configured: self._configure,
            SourceOpened: self._open_source,
            SourceClosed: self._close_source,
            Tick: lambda _: [],
            Request: self._answer,
            CalibrationSelected: self._update_session,
            JobFinished: self._update_session,
            JobProgress: self._update_session,
            CalibrationStored: self._update_session,
            UnixOffset: self._set_unix_offset,
        }

    # --- events ------------------------------------------------------------------------------

    def feed(self, event: Event) -> list[Output]:
        """Process one event, and return its outputs in order."""
        # Chunks are tested first, because they are a thousand times more frequent than all other
        # events.
        if isinstance(event, ChunkArrived):
            self._now_ns = max(self._now_ns, event.chunk.t_ns)
            return self._add_chunk(event)
        self._now_ns = max(self._now_ns, event.t_ns)
        return [*self._handlers[type(event)](event), *self._advance()]

    @property
    def next_deadline_ns(self) -> int | None:
        """Latest host time of the next ``Tick``, ns; None before the configuration."""
        return None if self._rig is None else self._aligner.next_deadline_ns

    @property
    def lags_ns(self) -> Mapping[str, int]:
        """Lags behind the optical system, by sensor, ns. They are subtracted from the stamps."""
        return self._lag_ns

    def descriptions(self) -> dict[str, tuple[bytes, ...]]:
        """Return, for each open source, the chunks that a new decoder needs before all others."""
        return {name: state.description() for name, state in self._sources.items()}

    def health(self, now_ns: int) -> CoreHealth:
        """Return the core's part of the MQTT topic ``bridge/health``."""
        if self._grid is None:
            return CoreHealth()

        fuser, session = self._fuser, self._session
        samples = {"mocap": self._mocap.counts()} | self._grid.counts()
        return CoreHealth(
            devices={
                name: state.health(now_ns, samples[name], fuser.sensor_monitor)
                for name, state in self._sources.items()
            },
            phase=session.phase,
            version=session.version,
            fusion={} if fuser.consistency is None else fuser.consistency.health(),
            lags={} if self._lags is None else self._lags.health(),
            frames=FrameCounts(self._seq, self._empty, self._aligner.skipped_frames),
            learning=session.refits.health(self._collector, now_ns),
        )

    # --- configuration -----------------------------------------------------------------------

    def _configure(self, event: Configured) -> list[Output]:
        before, rig = self._rig, event.rig
        self._rig = rig
        self._reload_sources(rig)

        outputs: list[Output] = []
        session = CalibrationSession(
            rig.chain,
            rig.calibration,
            mocap=bool(rig.cameras),
            calibration=event.calibration,
            version=event.calibration_version,
        )
        if before is not None:
            outputs += self._session.abort(event.t_ns, "the configuration was reloaded")
            outputs.append(
                Notice(event.t_ns, NoticeKind.RELOAD, rig.name, "configuration reloaded")
            )
            same_rig = _calibration_inputs(before) == _calibration_inputs(rig)
            session.resume(self._session, same_rig=same_rig)

        if self._grid is None:
            self._grid = FrameGrid(rig, event.t_ns)
        else:
            self._grid.reload(rig)
        self._aligner = self._grid.aligner
        if before is None or before.cameras != rig.cameras:
            self._moving_centers = self._chain_tracker = self._planar_tracker = None
        self._planar_tracker = planar_tracker(rig, self._planar_tracker)
        if before is None or before.chain != rig.chain:
            self._sensor_monitor = SensorMonitor(rig.chain)

        self._session = session
        fuser = None if before is None else self._fuser
        self._use_calibration()
        self._fuser.set_calibration_time(event.t_ns - round(event.calibration_age_s * 1e9))
        if fuser is not None:
            self._fuser.resume(fuser)

        if (warning := heading_warning(rig.sources)) is not None:
            outputs.append(
                Notice(event.t_ns, NoticeKind.DEVICE, rig.name, warning, NoticeLevel.WARNING)
            )
        outputs += unused_refinement(rig, self._usable, event.t_ns)
        text = "stored calibration loaded" if event.calibration else "no stored calibration"
        return [*outputs, session.status(event.t_ns, text)]

    def _reload_sources(self, rig: Rig) -> None:
        """Create the states of new and changed sources. Unchanged sources keep their state."""
        unchanged = {
            source.id: state
            for source in rig.sources
            if (state := self._sources.get(source.id)) is not None and state.source == source
        }
        self._sources = {
            s.id: unchanged.get(s.id) or SourceState.create(s, self._sources.get(s.id), self._lines)
            for s in rig.sources
        }
        self._feed_unix_offset()
        if not rig.cameras:
            self._mocap.reset_counts()

    def _use_calibration(self) -> None:
        rig, calibration = self._rig, self._session.calibration
        if rig is None:
            return
        no_north = drifting_imus(rig.sources)
        self._fuser = LimbFuser(rig.chain, calibration, self._sensor_monitor, no_north)
        self._usable = usable = calibration if calibration and calibration.fits(rig.chain) else None

        self._lags = LagMonitor(rig.chain, usable, self._lags, known_lags(rig))
        self._session.lags = self._lags
        self._mocap.set_calibration(rig.chain, usable)
        self._lag_ns = dict(calibration.lag_ns) if calibration is not None else {}
        self._lag_ns |= self._lags.known_lags_ns()
        self._comparison = OpticalComparison(rig.chain, usable, rig.mqtt.optical_hz)
        self._sensors_rate = RateDivider(rig.mqtt.sensors_hz) if rig.mqtt.sensors_hz > 0.0 else None
        centers = MovingCenters(rig.chain, usable, rig.mqtt.centers_memory_s)
        if self._moving_centers is None or not self._moving_centers.serves(centers):
            self._moving_centers = centers
        self._chain_tracker = chain_tracker(rig, usable, self._chain_tracker)
        self._label_monitor = label_monitor(rig, usable, self._label_monitor)
        learns = rig.calibration.learn_online
        self._collector = OnlineFrameCollector(rig.chain, usable, wanted=learns)

    # --- sources -----------------------------------------------------------------------------

    def _set_unix_offset(self, event: UnixOffset) -> list[Output]:
        before_ns, self._unix_offset_ns = self._unix_offset_ns, event.offset_ns
        self._feed_unix_offset()
        step_ns = 0 if before_ns is None else event.offset_ns - before_ns
        return [*unix_step_notices(event.t_ns, step_ns)] if step_ns else []

    def _feed_unix_offset(self) -> None:
        if self._unix_offset_ns is not None:
            for state in self._sources.values():
                state.clock.feed_unix_offset(self._unix_offset_ns)

    def _open_source(self, event: SourceOpened) -> list[Output]:
        state = self._sources.get(event.source)
        if state is not None:
            state.start()
        return []

    def _close_source(self, event: SourceClosed) -> list[Output]:
        state = self._sources.get(event.source)
        level = _CLOSED_LEVELS[event.reason]
        notice = Notice(event.t_ns, NoticeKind.DEVICE, event.source, event.text, level)
        if state is None:
            return [notice]

        # A failure is reported once, unless its reason changes or a sample arrives in between.
        repeated = not state.online and event.text == state.closed_text
        state.closed_text = event.text
        notices: list[Output] = [] if repeated else [notice]
        if not state.open:
            return notices

        outputs = self._process(event.source, state, state.stop())
        if state.source.kind == "imu":
            self._aligner.lose(event.source)
        return [*outputs, DeviceStatus(event.source, online=False), *notices]

    def _add_chunk(self, event: ChunkArrived) -> list[Output]:
        state = self._sources.get(event.source)
        if state is None:
            return []
        items = state.feed(event.chunk)
        if self.stages is not None:
            self.stages.mark_decoded(event.chunk.t_ns)
        outputs = self._process(event.source, state, items)

        # After the process was delayed, samples of other sources may still be in the kernel.
        # A chunk therefore applies no deadlines. All other events apply deadlines. One of them is
        # the Tick, which follows after all available data were read.
        return outputs + self._advance(complete_only=True)

    def _process(
        self,
        source: str,
        state: SourceState,
        items: list[StampedMeasurement | Corrupt | DeviceEvent],
    ) -> list[Output]:
        outputs: list[Output] = []
        for item in items:
            if not isinstance(item, StampedMeasurement):
                outputs += self._report(source, state, item)
                continue

            if state.open and not state.online:  # a closed decoder's last samples: stays offline
                state.online = True
                outputs.append(DeviceStatus(source, online=True))
                outputs.append(Notice(self._now_ns, NoticeKind.DEVICE, source, "streaming"))

            if self._observe is not None:
                self._observe(source, item)
            measurement, stamp = item
            if isinstance(measurement, ImuSample):
                outputs += self._add_sample(source, measurement, stamp)
            else:
                outputs += self._add_mocap(measurement, stamp)
        return outputs

    def _report(self, source: str, state: SourceState, item: Corrupt | DeviceEvent) -> list[Output]:
        if isinstance(item, DeviceEvent) and item.kind == "info":
            return [DeviceInfo(source, state.info)]
        outputs: list[Output] = []
        if isinstance(item, DeviceEvent) and item.kind == "restart" and state.source.kind == "imu":
            self._aligner.reset(source)
            outputs = self._session.restart_sensor(self._now_ns, source)
        notices = self._limiter.add(self._now_ns, source, item, state.source.rate_hz)
        return [*notices, *outputs]

    def _add_sample(self, source: str, sample: ImuSample, stamp: Stamp) -> list[Output]:
        t_ns, _, synced, epoch, _ = stamp
        q = sample.q_world_sensor

        # The aligner receives stamps minus the lag in use. These are instants on the clock of the
        # optical system.
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

    def _add_mocap(self, frame: MocapFrame, stamp: Stamp) -> list[Output]:
        outputs: list[Output] = []
        if self._label_monitor is not None and frame.live:
            # markers may be moved and renamed during a calibration
            if self._session.phase == CalibrationPhase.CALIBRATED:
                outputs += self._label_monitor.add_frame(stamp.t_ns, frame)
                frame = self._label_monitor.hide_faulty(frame)
            else:
                self._label_monitor.reset()

        item = StampedMeasurement(frame, stamp)
        self._mocap.add(self._now_ns, item, self._session, self._lags, self._collector)
        if not frame.live:
            return outputs
        self._comparison.add_frame(stamp.t_ns, frame, synced=stamp.synced)
        for tracker in (self._moving_centers, self._planar_tracker, self._chain_tracker):
            if tracker is not None:
                outputs += tracker.add_frame(stamp.t_ns, frame)
        return outputs

    # --- time --------------------------------------------------------------------------------

    def _advance(self, *, complete_only: bool = False) -> list[Output]:
        """Fuse the frames that are due, and do all other work that is due at this time."""
        if self._rig is None:
            return []
        now_ns = self._now_ns
        frames = self._aligner.advance(now_ns, complete_only=complete_only)
        if frames and self.stages is not None:
            self.stages.mark_aligned()
        outputs: list[Output] = []
        for frame in frames:
            state = self._fuse(frame)
            if self.stages is not None:
                self.stages.mark_fused(None if complete_only else frame.completed_ns)
            outputs += (state, *self._comparison.add_state(state))
            if self._sensors_rate is not None and self._sensors_rate.is_due(frame.t_ns):
                chain, usable = self._rig.chain, self._usable
                outputs.append(sensor_states(chain, usable, frame.orientations, state))
        if outputs and self._lags is not None:
            outputs += self._lags.step(now_ns)

        if self._session.collecting:
            exchanges = self._chain_tracker.exchanged_labels if self._chain_tracker else ()
            outputs += self._session.advance(now_ns, exchanges)
        elif outputs and self._session.may_learn:
            fresh = self._collector.take_due(now_ns)
            outputs += [] if fresh is None else self._session.request_refit(fresh)
            outputs += self._collector.notices(now_ns)

        outputs += self._limiter.due(now_ns)
        for report in self._fuser.pop_reports(now_ns):
            level, data = NoticeLevel(report.level), {"state": report.state, **report.data}
            outputs.append(Notice(now_ns, NoticeKind.SENSOR, report.id, report.text, level, data))
        return outputs

    def _fuse(self, frame: AlignedFrame) -> LimbState:
        self._seq += 1
        self._empty += not frame.orientations
        mocap = self._mocap.is_fresh(self._now_ns)

        self._fuser.worn = self._session.phase != CalibrationPhase.ALIGN
        state = self._fuser.fuse(
            frame.t_ns,
            frame.completed_ns,
            self._seq,
            frame.orientations,
            extrapolated=frame.extrapolated,
            optical_origin=self._mocap.origin if mocap else None,
            sync=SyncState.LOCKED if frame.synced else SyncState.SETTLING,
            mode=FusionMode.IMU_AND_MOCAP if mocap else FusionMode.IMU,
        )
        self._collector.add_frame(frame, state.flags)
        return state

    # --- requests and calibration ------------------------------------------------------------

    def _answer(self, request: Request) -> list[Output]:
        if request.command in ("calibrate", "static"):
            return self._update_session(request)
        if request.command == "mark":
            self._marks += 1
            name = "" if self._rig is None else self._rig.name
            return mark_outputs(request, self._marks, self._unix_offset_ns, name)
        known = f"unknown request {request.command!r}; known: calibrate, static, mark"
        return [request.refusal("command", known)]

    def _update_session(
        self,
        event: Request | CalibrationSelected | JobFinished | JobProgress | CalibrationStored,
    ) -> list[Output]:
        """Pass an event to the session, and use the new calibration if there is one."""
        before = self._session.calibration
        if isinstance(event, JobFinished):
            outputs = self._session.finish_job(event)
        elif isinstance(event, JobProgress):
            outputs = self._session.report_job(event)
        elif isinstance(event, CalibrationStored):
            outputs = self._session.set_stored_version(event)
        elif isinstance(event, CalibrationSelected):
            outputs = self._session.select(event)
        else:
            outputs = self._session.request(event)

        after = self._session.calibration
        if before and after and after is not before and only_models_differ(before, after):
            self._fuser.replace_models(after)
        elif after is not before:
            self._use_calibration()
            if isinstance(event, CalibrationSelected):
                self._fuser.set_calibration_time(event.t_ns - round(event.age_s * 1e9))
        return outputs


def _calibration_inputs(rig: Rig) -> tuple[object, ...]:
    """Return the parts of a rig that affect a static pose or an alignment."""
    return rig.chain, rig.calibration, rig.sources
