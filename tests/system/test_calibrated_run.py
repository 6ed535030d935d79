"""Payloads, log and replay of a run with calibration, reconnection and reload.

The run takes most of a minute, so all subtests use the same run.
"""

from __future__ import annotations

import asyncio
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.outputs.recording import read_events
from jointfit_daemon.pipeline.events import Configured, JobFinished, SourceClosed, SourceOpened
from jointfit_daemon.reprocessing import verify_recording
from tests.payload_check import payload_fault
from tests.system.station import SENSORS, Listener, Station, hang_up, running, stopped

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.tools.child_processes import ChildProcess, Simulator
    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(300)]

SETTLE_S = 1.7
"""Time after a change of motion, s. Two motions are blended for 1.5 s."""
PAGE = Path(__file__).resolve().parents[2] / "docs" / "mqtt.md"
TOPICS = (
    "pose/ui", "optical/pose", "optical/chain", "optical/centers", "sensors/pose", "joint/+",
    "calibration/progress", "bridge/log", "device/+/info",
)  # fmt: skip
"""Topics in addition to the topics of the listener."""
NAMES = {
    *SENSORS, *(f"{a}{mark}{b}" for a in SENSORS for b in SENSORS for mark in "~+"),
    "mocap", "hip", "knee", "ankle", "thigh", "shank", "pelvis", "foot", "shank_angle",
    *(f"{part}_{axis}" for part in ("pelvis", "thigh", "foot") for axis in ("rx", "ry", "rz")),
    *(f"pelvis_{axis}" for axis in ("tx", "ty", "tz")), "P1", "T1", "T2", "C1",
}  # fmt: skip
"""Keys that are names of devices, segments, joints, coordinates, markers or pairs of sensors."""
FREE = re.compile(r"device/\w+/info|bridge/log")
"""Topics whose keys depend on the device, or that are not published in every run."""


@dataclass(frozen=True)
class CalibratedRun:
    """Results of the run."""

    log: str
    recording: Path
    keys: dict[str, set[str]]
    """Keys of all payloads, by topic."""
    optical: list[dict[str, Any]]
    """Payloads of `optical/pose`."""
    centers: list[dict[str, Any]]
    """Payloads of `optical/centers`."""
    chain: list[dict[str, Any]]
    """Payloads of `optical/chain`."""
    misfits: dict[str, str]
    """Last difference between a payload and the model of its topic, by topic."""


async def calibrated_run(folder: Path, port: int) -> CalibratedRun:
    options = ("--chain-model", "--sensors-hz", "5")
    mqtt_toml = "centers_memory_s = 5.0\n"
    station = Station(folder, port, options, more_toml="[recording]\n", mqtt_toml=mqtt_toml)
    found: dict[str, set[str]] = {}
    optical: list[dict[str, Any]] = []
    centers: list[dict[str, Any]] = []
    chain: list[dict[str, Any]] = []
    misfits: dict[str, str] = {}
    take = Listener._take

    def note(self: Listener, topic: str, payload: Any) -> None:
        found.setdefault(topic, set()).update(keys(payload))
        if (misfit := payload_fault(topic, payload)) is not None:
            misfits[topic] = misfit
        if topic == "optical/pose":
            optical.append(payload)
        if topic == "optical/centers":
            centers.append(payload)
        if topic == "optical/chain":
            chain.append(payload)
        take(self, topic, payload)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Listener, "_take", note)
        async with running(station) as (simulator, daemon, listener):
            assert listener.client is not None
            await listener.client.subscribe(*TOPICS)
            answer = await listener.client.request("calibrate", {"phase": "abort"})
            found["bridge/response/calibrate"] = set(keys(answer))

            await calibrate(simulator, listener)
            await listener.until(lambda: listener.latest["calibration"]["version"])
            assert listener.latest["calibration"]["phase"] == "calibrated"
            await listener.more_poses(120)
            await listener.until(lambda: centers and centers[-1]["joints"]["knee"]["shift_m"])

            await reconnect(simulator, listener, "S1")
            await reload(station, daemon, listener)
            assert listener.latest["bridge/health"]["recording"]["failure"] is None
            code, _ = await stopped(daemon)
            assert code == 0, station.log

    (recording,) = (folder / "state" / "recordings").iterdir()
    return CalibratedRun(station.log, recording, found, optical, centers, chain, misfits)


async def calibrate(simulator: Simulator, listener: Listener) -> None:
    for motion, phase, seconds in (
        ("plate", "align", 8.0), ("stand", "static", 3.0), ("functional", "functional", 12.0),
    ):  # fmt: skip
        await simulator.send_command(f"play {motion}")
        await asyncio.sleep(SETTLE_S)
        await listener.phase(phase, seconds)


async def reconnect(simulator: Simulator, listener: Listener, name: str) -> None:
    await simulator.send_command(f"unplug {name}")
    await listener.disconnected({name})
    await asyncio.sleep(0.5)
    await simulator.send_command(f"plug {name}")
    await listener.connected({name})
    await listener.more_poses(30)


async def reload(station: Station, daemon: ChildProcess, listener: Listener) -> None:
    station.write_rig(
        ("output_rate_hz = 100", "output_rate_hz = 80"),
        ('id = "S3"\n', 'id = "S3"\nsilence_s = 0.8\n'),
    )
    del listener.latest["device/S3/availability"]  # S3 is closed and opened again
    hang_up(daemon)
    await listener.event("demo", "configuration reloaded")
    await listener.connected({*SENSORS, "mocap"})
    await listener.more_poses(80)


def keys(value: Any) -> Iterator[str]:
    """Yield all keys of a payload except names of devices, segments, joints and markers."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in NAMES and not re.fullmatch(r"[A-Z]+[a-z_]*\d*", key):
                yield key
            yield from keys(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from keys(inner)


def documented_words() -> set[str]:
    """Return all words in code spans and code blocks of `PAGE`."""
    text = PAGE.read_text(encoding="utf-8")
    spans = re.findall(r"```.*?```|`[^`\n]+`", text, re.DOTALL)
    return set(re.findall(r"\w+", " ".join(spans)))


def keys_of_examples() -> set[str]:
    """Return the keys in the examples of payloads in `PAGE`."""
    text = PAGE.read_text(encoding="utf-8")
    examples = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    examples = [body for body in examples if '"sticks"' not in body]  # a planar rig
    return set(re.findall(r'"(\w+)":', " ".join(examples))) - NAMES


async def test_payloads_log_and_replay_of_a_calibrated_run(
    tmp_path: Path, broker: Broker, subtests: pytest.Subtests
) -> None:
    run = await calibrated_run(tmp_path, broker.port)
    with subtests.test("every published key is documented and every documented key is published"):
        compare_keys_with_the_page(run)
    with subtests.test("every published payload fits its model"):
        assert run.misfits == {}
    with subtests.test("the log has one line for each phase and no output of the worker"):
        count_phases_in_the_log(run)
    with subtests.test("cameras and IMUs are compared at one instant"):
        judge_the_optical_reference(run)
    with subtests.test("running centers agree with the calibrated ones"):
        judge_the_running_centers(run)
    with subtests.test("the chain model is fitted to the markers"):
        judge_the_chain_model(run)
    with subtests.test("the recording replays to byte-identical limb states"):
        replay_the_recording(run)


def compare_keys_with_the_page(run: CalibratedRun) -> None:
    documented = documented_words()
    unknown = {
        topic: missing
        for topic, used in run.keys.items()
        if not FREE.fullmatch(topic) and (missing := used - documented)
    }
    assert unknown == {}
    assert {topic for topic, used in run.keys.items() if "v" not in used} == set()

    used = set().union(*run.keys.values())
    assert keys_of_examples() - used == set()


def count_phases_in_the_log(run: CalibratedRun) -> None:
    for line in (
        "calibration align: ", "calibration aligned: ", "calibration posed: ",
        "calibration: calibrated", "calibration calibrated: stored as version 1 (/",
    ):  # fmt: skip
        assert run.log.count(line) == 1, (line, run.log)
    assert "output of the worker" not in run.log  # fits print nothing


def judge_the_optical_reference(run: CalibratedRun) -> None:
    """Check the published differences between cameras and IMUs."""
    rate_hz = (len(run.optical) - 1) / (run.optical[-1]["t_us"] - run.optical[0]["t_us"]) * 1e6
    assert 10 < rate_hz <= 25.5  # includes the pause of the reload
    knees = [payload["joints"]["knee"] for payload in run.optical]
    compared = [knee for knee in knees if knee["residual"] is not None]
    assert len(compared) > 0.5 * len(knees)
    assert 0.0 < compared[-1]["residual_rms"]["flexion_deg"] < 8.0
    assert 0.0 < compared[-1]["residual_rms_m"] < 0.05
    assert 0.0 < compared[-1]["gap_m"] < 0.03


def judge_the_running_centers(run: CalibratedRun) -> None:
    """Check that the joint centres estimated during the run agree with the calibrated centres."""
    stamps = [payload["t_us"] for payload in run.centers]
    assert all(b - a > 0.8e6 for a, b in pairwise(stamps))
    knees = [payload["joints"]["knee"] for payload in run.centers]
    compared = [knee for knee in knees if knee["shift_m"] is not None]
    assert not any(knee["moved"] for knee in compared)
    assert max(map(abs, compared[-1]["shift_m"])) < 0.05


def judge_the_chain_model(run: CalibratedRun) -> None:
    """Check the fit of the chain model to the markers before and after their refinement."""
    rate_hz = (len(run.chain) - 1) / (run.chain[-1]["t_us"] - run.chain[0]["t_us"]) * 1e6
    assert 4 < rate_hz <= 10.5
    assert run.chain[-1]["fit"]["rms_m"] < 0.02

    # The calibration refines the markers, and the reload reads them from its file.
    refined = [payload["refined"] for payload in run.chain]
    assert refined == sorted(refined)
    errors = {kind: [p["fit"]["rms_m"] for p in run.chain if p["refined"] is kind and p["fit"]]
              for kind in (False, True)}  # fmt: skip
    assert np.median(errors[True]) < 0.7 * np.median(errors[False])
    stored = [e.calibration for e in read_events(run.recording) if isinstance(e, Configured)][1]
    assert stored is not None
    assert stored.chain is not None
    figures = stored.quality["chain"]
    assert figures["after"]["rms_m"] < figures["before"]["rms_m"]
    assert figures["after"]["accepted"]

    # The x axis points to the right, so knee flexion is a negative angle of the shank.
    knees = [p["coordinates"]["shank_angle"]["value_deg"] for p in run.chain]
    known = [angle for angle in knees if angle is not None]
    assert len(known) > 0.9 * len(knees)
    assert min(known) < -40.0
    assert max(known) < 25.0


def replay_the_recording(run: CalibratedRun) -> None:
    events = list(read_events(run.recording))
    assert len([e for e in events if isinstance(e, Configured)]) == 2
    assert len([e for e in events if isinstance(e, JobFinished)]) == 3
    opened = [e.source for e in events if isinstance(e, SourceOpened)]
    assert (opened.count("S1"), opened.count("S2"), opened.count("S3")) == (2, 1, 2)
    assert {e.reason for e in events if isinstance(e, SourceClosed)} == {"lost", "removed"}

    verified = verify_recording(run.recording)
    assert verified.passed, verified.lines()
    assert verified.compared["output/state"] > 2000
    assert {"output/optical", "output/coordinates", "output/notice"} <= verified.compared.keys()
