"""Guided steps of a sensor calibration, live or from a recording.

The driver runs as in the daemon, but its decoder returns raw readings instead of orientations.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from jointfit_daemon.calibration.inertial_sensor import (
    AccelerometerEstimate,
    AccelerometerStep,
    GyroscopeEstimate,
    GyroscopeScaleEstimate,
    GyroscopeStep,
    MagnetometerEstimate,
    MagnetometerStep,
    SensorCalibrationError,
    SensorReading,
    StepProgress,
)
from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import DeviceEvent, ImuSample

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from jointfit_daemon.config import Source
    from jointfit_daemon.driver import Decoder
    from jointfit_daemon.model import Chunk

Step = GyroscopeStep | AccelerometerStep | MagnetometerStep
Estimate = GyroscopeEstimate | GyroscopeScaleEstimate | AccelerometerEstimate | MagnetometerEstimate

STEPS: dict[str, type[Step]] = {
    "gyroscope": GyroscopeStep,
    "accelerometer": AccelerometerStep,
    "magnetometer": MagnetometerStep,
}
INSTRUCTIONS = {
    "gyroscope": "Lay {id} on a table and do not touch it until the next step.",
    "accelerometer": "Lay {id} on each of its six faces, then lean it against an object in six "
    "tilted poses. Let go of it for two seconds in each pose. The order does not matter.",
    "magnetometer": "Hold {id} in your hand, away from steel, and turn it slowly on the spot until "
    "each of its sides has pointed in every direction.",
}
GYROSCOPE_SCALE = "gyroscope_scale"
"""Key of the scale and axes of the gyroscope, estimated from the rotations between the static poses
of the accelerometer step."""
_SHOW_S = 0.25
"""Time between two updates of the displayed progress, s."""


@dataclass(slots=True)
class SensorFindings:
    """Results of the calibration steps."""

    estimates: dict[str, Estimate] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    """Reason why a step has no result, by step."""
    not_estimated: dict[str, str] = field(default_factory=dict)
    """Reason why an additional quantity is not estimated, by quantity."""
    serial: str | None = None
    """Serial number, if the sensor reported one."""
    warnings: list[str] = field(default_factory=list)
    """Warnings about the device."""

    def finish(self, name: str, step: Step) -> None:
        """Add the result of a step, or the reason why the step has no result."""
        try:
            estimate = step.finish()
        except SensorCalibrationError as error:
            self.refused[name] = str(error)
            return

        self.estimates[name] = estimate
        if isinstance(step, AccelerometerStep) and isinstance(estimate, AccelerometerEstimate):
            try:
                self.estimates[GYROSCOPE_SCALE] = step.finish_gyroscope_scale(estimate)
            except SensorCalibrationError as error:
                self.not_estimated[GYROSCOPE_SCALE] = str(error)


class Display(Protocol):
    """Shows instructions and progress."""

    def begin(self, instruction: str) -> None:
        """Show the instruction of the next step."""

    def show(self, progress: StepProgress) -> None:
        """Show the progress of the current step."""


class ReadingStream:
    """Converts chunks of one sensor to readings.

    Parameters
    ----------
    source
        Sensor of a rig; its settings must support sensor calibration.
    findings
        Object that stores the serial number and the warnings.
    """

    def __init__(self, source: Source, findings: SensorFindings) -> None:
        self._decoder: Decoder = source.driver_class(source.settings.for_readings()).decoder()
        self._findings = findings
        self.samples_without_rate = 0
        """Number of samples that contain an orientation but no raw readings."""

    def feed(self, chunk: Chunk) -> list[SensorReading]:
        """Return the readings that a chunk completes."""
        readings, findings = [], self._findings
        for item in self._decoder.feed(chunk):
            if isinstance(item, ImuSample):
                if item.rate is None or item.acceleration is None:
                    self.samples_without_rate += 1
                    continue
                vectors = (item.rate, item.acceleration, item.magnetic)
                readings.append(SensorReading(item.arrival_ns, *vectors))
            elif isinstance(item, DeviceEvent):
                if "serial" in item.data:
                    findings.serial = str(item.data["serial"])
                if item.kind in {"warning", "error"} and item.text not in findings.warnings:
                    findings.warnings.append(item.text)
        return readings


async def run_steps(
    source: Source, names: Sequence[str], display: Display, *, step_s: float
) -> SensorFindings:
    """Guide the user through the calibration steps of a live sensor.

    Parameters
    ----------
    source
        Sensor of a rig; its settings must support sensor calibration.
    names
        Steps, keys of `STEPS`.
    display
        Display of instructions and progress.
    step_s
        Time limit of a step, s; a step ends earlier if it is complete.

    Raises
    ------
    SensorCalibrationError
        The device is lost or misconfigured, or sends no raw readings.
    """
    findings = SensorFindings()
    stream = ReadingStream(source, findings)
    present: list[Step] = []

    def emit(chunk: Chunk) -> None:
        for reading in stream.feed(chunk):
            if present and not present[0].is_complete:
                present[0].add(reading)

    driver: Any = source.driver_class(source.settings.for_readings())
    reading = asyncio.create_task(driver.run(emit))
    try:
        for name in names:
            step = STEPS[name]()
            present[:] = [step]
            display.begin(INSTRUCTIONS[name].format(id=source.id))
            await _wait_for(step, reading, display, step_s, source.id)
            findings.finish(name, step)
    finally:
        reading.cancel()
        await asyncio.wait([reading])

    if stream.samples_without_rate:
        findings.warnings.append(
            f"{stream.samples_without_rate} samples without raw readings were ignored"
        )
    return findings


async def _wait_for(
    step: Step, reading: asyncio.Task[None], display: Display, step_s: float, name: str
) -> None:
    """Wait until a step is complete, its time limit is exceeded, or the device is lost."""
    loop = asyncio.get_running_loop()
    end_s = loop.time() + step_s
    while not step.is_complete and loop.time() < end_s:
        await asyncio.wait({reading}, timeout=_SHOW_S)
        if reading.done():
            error = reading.exception()
            if isinstance(error, DeviceLostError | DeviceMisconfiguredError):
                raise SensorCalibrationError(f"{name}: {error}") from error
            reading.result()
            raise SensorCalibrationError(
                f"{name}: its driver ended without an error: repeat the calibration"
            )
        display.show(step.progress)
    display.show(step.progress)


def take_recorded(source: Source, names: Sequence[str], chunks: Iterable[Chunk]) -> SensorFindings:
    """Process recorded chunks in all steps; the movements may have any order.

    Parameters
    ----------
    source
        Sensor of the recorded rig; its settings must support sensor calibration.
    names
        Steps, keys of `STEPS`.
    chunks
        Recorded chunks of the sensor, in the order of time.
    """
    findings = SensorFindings()
    stream = ReadingStream(source, findings)
    steps = {name: STEPS[name]() for name in names}
    for chunk in chunks:
        for reading in stream.feed(chunk):
            for step in steps.values():
                if not step.is_complete:
                    step.add(reading)
    for name, step in steps.items():
        findings.finish(name, step)
    return findings
