"""After any sequence of requests, faults, fits and reloads, the session can calibrate."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from typing_extensions import override

from jointfit_daemon.calibration import (
    AlignJob,
    CalibrationSettings,
    FitResult,
    OnlineFrames,
    StaticJob,
)
from jointfit_daemon.model import Chain
from jointfit_daemon.pipeline.calibration_session import CalibrationSession
from jointfit_daemon.pipeline.calibration_session._state_machine import COLLECTING, RESTING
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationReady,
    CalibrationSelected,
    CalibrationStored,
    CancelJob,
    FitJob,
    JobFinished,
    Reply,
    Request,
)
from tests.limb_model.plain_calibration import plain_calibration
from tests.pipeline.calibration_session.test_calibration_session import seen, turned

if TYPE_CHECKING:
    from collections.abc import Collection

    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.events import Output

SECOND = 1_000_000_000
RATE = 10
"""Sample rate, Hz. At least two samples per second are necessary."""
LEG = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (("S1",), ("S2",)))
ARM = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (("S1",), ("S3",)))
MARKERS = {segment: tuple(f"{segment}{k}" for k in range(3)) for segment in LEG.segments}
SETTINGS = CalibrationSettings(
    static_s=1.0, align_s=1.0, functional_s=1.0, functional_min_s=0.5, markers=MARKERS, plate="P"
)
OUTCOMES = ("good", "worse", "refused", "failed")
NO_FRAMES = OnlineFrames({}, {}, {})


class SessionMachine(RuleBasedStateMachine):
    """One session with a worker and a store, which may fail at any time."""

    def __init__(self) -> None:
        super().__init__()
        self.t_ns = 0
        self.chain, self.mocap, self.number = LEG, True, 0
        self.stored: dict[int, Calibration] = {}
        self.writes: list[Calibration] = []
        self.jobs: list[FitJob] = []
        self.running: FitJob | None = None
        self.outdated: set[int] = set()
        """Numbers of fits whose trials precede a restart of a sensor."""
        self.session = self.new_session()

    def new_session(self) -> CalibrationSession:
        """Return a session with the calibration that the supervisor would load."""
        found, version = None, None
        if self.writes:
            found = self.writes[-1]
        elif self.stored:
            version = max(self.stored)
            found = self.stored[version]
        if found is None or not found.fits(self.chain):
            found = version = None
        return CalibrationSession(
            self.chain, SETTINGS, mocap=self.mocap, calibration=found, version=version
        )

    def made(self) -> Calibration:
        """Return a calibration that differs from all others."""
        self.number += 1
        return plain_calibration(self.chain, notes=(f"calibration {self.number}",))

    def take(self, outputs: list[Output]) -> list[Output]:
        """Process the outputs as the supervisor does."""
        for output in outputs:
            if isinstance(output, FitJob):
                self.running = output
                self.jobs.append(output)
            elif isinstance(output, CancelJob):
                self.running = None
            elif isinstance(output, CalibrationReady):
                self.writes.append(output.calibration)
        return outputs

    def ask(self, **arguments: Any) -> Reply:
        """Send a request; a refused request must have no effect."""
        before = self.state()
        outputs = self.take(self.session.request(Request(self.t_ns, "calibrate", "t", arguments)))
        (reply,) = (output for output in outputs if isinstance(output, Reply))
        if reply.status == "error":
            assert self.state() == before, "a refused request changed the session"
        return reply

    def state(self) -> tuple[object, ...]:
        """Return the state that a refused request must not change."""
        one = self.session
        refits = (one.refits.paused, one.refits.job, one.refits.original)
        return one.phase, one.calibration, one.version, one.collecting, one._done, refits

    def move(self, seconds: float, speed: float, silent: Collection[str] = ()) -> None:
        """Make the sensors and cameras send, except the `silent` ones."""
        for _ in range(round(seconds * RATE)):
            self.t_ns += SECOND // RATE
            for sensor in ("S1", "S2"):
                if sensor not in silent:
                    q = turned(speed * self.t_ns / SECOND)
                    self.take(self.session.add_sample(sensor, self.t_ns, q))
            if "mocap" not in silent:
                self.session.add_mocap(self.t_ns, seen(self.t_ns))
            if self.session.collecting:
                self.take(self.session.advance(self.t_ns))

    def finish(self, job: FitJob, outcome: str) -> None:
        """Deliver the end of a job, also of a cancelled job whose result may be in transit."""
        if job is self.running:
            self.running = None
        result: dict[str, Any] = {"quality": {}}
        if outcome == "refused":
            result["refused"] = "moved too little"
        elif isinstance(job.work, AlignJob):
            result["alignment"] = {"sensors": {}, "notes": []}
        elif not isinstance(job.work, StaticJob) or job.work.previous is not None:
            found = replace(self.made(), quality={"online": {"frames": 1}})
            result |= {"calibration": found.to_dict()}
            result |= {"worse": "knee 3 against 1 deg"} if outcome == "worse" else {}
        content = None if outcome == "failed" else FitResult.from_dict(result)
        error = "the worker was killed" if outcome == "failed" else None
        before = self.session.calibration
        self.take(self.session.finish_job(JobFinished(self.t_ns, job.job, content, error)))
        if job.job in self.outdated:
            assert self.session.calibration is before, "a pose before a restart is used"
            assert self.session._static is None, "a pose before a restart is recorded"

    # --- requests --------------------------------------------------------------------------------

    @rule(
        phase=st.sampled_from([*COLLECTING, *COLLECTING, "abort", "revert", "nonsense"]),
        seconds=st.sampled_from([None, None, 0.6, -1, "soon"]),
        force=st.booleans(),
    )
    def request(self, phase: str, seconds: object, force: bool) -> None:
        self.ask(phase=phase, seconds=seconds, force=force)

    @precondition(lambda self: self.stored)
    @rule(data=st.data())
    def choose_stored(self, data: st.DataObject) -> None:
        version = data.draw(st.sampled_from(sorted(self.stored)))
        request = Request(self.t_ns, "use-calibration", "t", {"version": version})
        before, chosen = self.state(), self.stored[version]
        outputs = self.take(
            self.session.select(CalibrationSelected(self.t_ns, chosen, version, 0.0, request))
        )
        (reply,) = (output for output in outputs if isinstance(output, Reply))
        if reply.status == "error":
            assert self.state() == before

    # --- measurements and faults -----------------------------------------------------------------

    @rule(
        seconds=st.sampled_from([0.3, 1.2, 2.5]),
        speed=st.sampled_from([0.0, 0.0, 1.0]),
        silent=st.sets(st.sampled_from(["S1", "S2", "mocap"]), max_size=2),
    )
    def send(self, seconds: float, speed: float, silent: set[str]) -> None:
        self.move(seconds, speed, silent)

    @rule()
    def wait_for_stillness_in_vain(self) -> None:
        self.t_ns += 121 * SECOND
        if self.session.collecting:
            self.take(self.session.advance(self.t_ns))

    @rule(sensor=st.sampled_from(["S1", "S2"]))
    def restart_sensor(self, sensor: str) -> None:
        fit = self.session._fit
        if fit is not None and fit.work.name in ("align", "static"):
            self.outdated.add(fit.job)
        self.take(self.session.restart_sensor(self.t_ns, sensor))
        assert self.session._static is None

    # --- worker and store ------------------------------------------------------------------------

    @precondition(lambda self: self.jobs)
    @rule(data=st.data(), outcome=st.sampled_from(OUTCOMES))
    def finish_any_job(self, data: st.DataObject, outcome: str) -> None:
        self.finish(self.jobs.pop(data.draw(st.integers(0, len(self.jobs) - 1))), outcome)

    @precondition(lambda self: self.running is not None)
    @rule(outcome=st.sampled_from(["good", *OUTCOMES]))
    def finish_running_job(self, outcome: str) -> None:
        assert self.running is not None
        self.jobs.remove(self.running)
        self.finish(self.running, outcome)

    @precondition(lambda self: self.session.may_learn)
    @rule()
    def learn_online(self) -> None:
        self.take(self.session.request_refit(NO_FRAMES))

    @precondition(lambda self: self.session.may_learn)
    @rule()
    def use_new_models(self) -> None:
        self.take(self.session.request_refit(NO_FRAMES))
        assert self.running is not None
        self.finish_running_job("good")

    @precondition(lambda self: self.session._state in RESTING)
    @rule()
    def record_static_pose(self) -> None:
        if self.ask(phase="static").status == "accepted":
            self.move(3.0, 0.0)

    @precondition(lambda self: self.writes)
    @rule()
    def write_calibrations(self) -> None:
        """Write the versions one after another, and report the last version."""
        for found in self.writes:
            self.stored[len(self.stored) + 1] = found
        self.writes = []
        self.take(self.session.set_stored_version(CalibrationStored(self.t_ns, len(self.stored))))

    # --- reloads ---------------------------------------------------------------------------------

    @rule(chain=st.sampled_from([LEG, LEG, ARM]), mocap=st.booleans())
    def reload(self, chain: Chain, mocap: bool) -> None:
        same = (chain, mocap) == (self.chain, self.mocap)
        self.chain, self.mocap = chain, mocap
        before = self.session
        self.take(before.abort(self.t_ns, "the configuration was reloaded"))
        self.session = self.new_session()
        self.session.resume(before, same_rig=same)

    @rule()
    def restart_daemon(self) -> None:
        """Restart the daemon: unwritten results are lost, and the written calibration is active."""
        self.writes, self.jobs, self.running = [], [], None
        self.outdated.clear()
        self.session = self.new_session()

    # --- claims ----------------------------------------------------------------------------------

    @invariant()
    def the_phase_has_its_work(self) -> None:
        one = self.session
        assert one.collecting == (one.phase in COLLECTING)
        assert (one._fit is not None) == (one.phase == CalibrationPhase.FITTING)
        assert one._state in RESTING or one.collecting or one._fit is not None
        if one._fit is not None:
            assert self.running is one._fit, "the session waits for a job that does not run"

    @invariant()
    def the_version_is_that_of_the_calibration_in_force(self) -> None:
        one = self.session
        if one.version is not None:
            assert one.calibration is not None
            assert self.stored[one.version] == one.calibration

    @invariant()
    def the_calibration_in_force_is_stored_or_will_be(self) -> None:
        one = self.session
        if one.calibration is not None and one.version is None:
            assert self.writes
            assert self.writes[-1] == one.calibration

    @override
    def teardown(self) -> None:
        """Abort the session from any state, then complete all phases."""
        assert self.ask(phase="abort").status == "ok"
        if self.chain is ARM or not self.mocap:
            self.reload(LEG, mocap=True)
        self.outdated.clear()
        for phase in COLLECTING:
            assert self.ask(phase=phase).status == "accepted"
            self.move(3.0, 0.0)
            assert self.running is not None, f"{phase} does not end"
            self.finish(self.running, "good")
        assert self.session.phase == CalibrationPhase.CALIBRATED
        assert self.writes
        self.write_calibrations()


def test_no_sequence_of_requests_faults_and_reloads_is_a_dead_end() -> None:
    run_state_machine_as_test(
        SessionMachine, settings=settings(max_examples=20, stateful_step_count=25)
    )


@pytest.mark.experiment
def test_no_long_sequence_is_a_dead_end() -> None:
    run_state_machine_as_test(
        SessionMachine, settings=settings(max_examples=60, stateful_step_count=50)
    )
