"""Guided test of one sensor: three rotations by hand show whether its frames are as configured.

The driver runs as in the daemon. Its chunks are kept, so that other values of the keys `direction`
and `world` are tried on the same movement.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import numpy as np

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.model import ImuSample
from jointfit_daemon.tools.probe._frame_judgement import explain_frames, fit_frames
from jointfit_daemon.tools.probe._rest_finder import RestFinder

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.config import Source
    from jointfit_daemon.model import Chunk, Quaternion

STEPS = (
    "Lay {id} flat, its z axis up, and let go.",
    "Turn it on the table by a quarter turn, counter-clockwise seen from above, and let go.",
    "Tip it by a quarter turn about its x axis, so that its y axis points up, and hold it still.",
    "Turn it, as it stands, by a quarter turn, counter-clockwise seen from above.",
)
"""Instructions; the sensor rests after each."""
OPEN_S = 20.0
"""Longest time from opening to the first orientation, s; a search at other speeds is included."""
Result = TypeVar("Result")
_KEYS = ("direction", "world")
"""Keys of a driver that change how quaternions are read."""


@dataclass(frozen=True, slots=True)
class PhysicalTestResult:
    """Outcome of the test of one sensor."""

    id: str
    agrees: bool
    """Whether world, axes and direction are as configured."""
    deviations_deg: tuple[float, float, float]
    """Deviation of each measured rotation from the one that was asked for, deg."""
    found: str
    """Convention of the quaternions as received, in words."""
    rig_toml: tuple[str, ...]
    """Keys of its ``[[imu]]`` table that correct the reading; empty if none is needed or none
    does."""
    alternatives: tuple[str, ...]
    """Other corrections that fit equally: they differ by the heading only."""


class PhysicalTestError(Exception):
    """The sensor sent no orientation, or did not rest in time."""


async def run_physical_test(
    source: Source, tell: Callable[[str], None], *, step_s: float
) -> PhysicalTestResult:
    """Guide through the rotations, and judge them.

    Parameters
    ----------
    source
        Sensor of a rig.
    tell
        Called with each instruction.
    step_s
        Longest time for a step, s.

    Raises
    ------
    PhysicalTestError
        The device is lost or misconfigured, or a step took longer than `step_s`.
    """
    driver = source.driver_class(source.settings)
    decoder = driver.decoder()
    finder: RestFinder | None = None
    chunks: list[Chunk] = []
    rests: asyncio.Queue[tuple[int, int]] = asyncio.Queue()
    sends = asyncio.Event()

    def emit(chunk: Chunk) -> None:
        chunks.append(chunk)
        for item in decoder.feed(chunk):
            if isinstance(item, ImuSample):
                sends.set()
                if finder is not None and (
                    rest := finder.add(item.arrival_ns, item.q_world_sensor)
                ):
                    rests.put_nowait(rest)

    tell(f"Opening {source.id} …")
    reading = asyncio.create_task(driver.run(emit))
    found: list[tuple[int, int]] = []
    try:
        await _first_orientation(source.id, reading, sends)
        finder = RestFinder()  # a rest before the first instruction does not count
        for step in STEPS:
            tell(step.format(id=source.id))
            found.append(await _next_rest(source.id, reading, rests, step_s))
    finally:
        reading.cancel()
        await asyncio.wait([reading])
    return judge_recording(source, chunks, found)


async def _first_orientation(name: str, reading: asyncio.Task[None], sends: asyncio.Event) -> None:
    """Wait for an orientation, so that a silent device is reported before any instruction."""
    if await _result_of(name, reading, sends.wait(), OPEN_S) is None:
        raise PhysicalTestError(
            f"{name}: no orientation within {OPEN_S:g} s: `jointfit doctor` names the cause"
        )


async def _next_rest(
    name: str, reading: asyncio.Task[None], rests: asyncio.Queue[tuple[int, int]], step_s: float
) -> tuple[int, int]:
    rest = await _result_of(name, reading, rests.get(), step_s)
    if rest is None:
        raise PhysicalTestError(
            f"{name}: not moved and at rest within {step_s:g} s: repeat the test, and hold the "
            "sensor still for a second after each rotation"
        )
    return rest


async def _result_of(
    name: str, reading: asyncio.Task[None], awaited: Coroutine[Any, Any, Result], limit_s: float
) -> Result | None:
    """Return the result of `awaited`; None after `limit_s`.

    Raises
    ------
    PhysicalTestError
        The driver ended before.
    """
    waiting = asyncio.create_task(awaited)
    await asyncio.wait({waiting, reading}, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
    if waiting.done():
        return waiting.result()

    waiting.cancel()
    if reading.done():
        error = reading.exception()
        if isinstance(error, DeviceLostError | DeviceMisconfiguredError):
            raise PhysicalTestError(f"{name}: {error}") from error
        reading.result()
    return None


def judge_recording(
    source: Source, chunks: Sequence[Chunk], rests: Sequence[tuple[int, int]]
) -> PhysicalTestResult:
    """Judge a recorded test, and find the settings that agree with it.

    Parameters
    ----------
    source
        Sensor of a rig.
    chunks
        All its chunks, in order.
    rests
        Begin and end of each rest, ns.
    """
    poses, received = _poses(source, source.settings, chunks, rests)
    fit = fit_frames(poses)
    one, two, three = np.degrees(fit.deviations_rad).tolist()
    corrections: list[str] = []
    if not fit.agrees:
        for change in _other_settings(source.settings):
            changed = source.settings.model_copy(update=change)
            if fit_frames(_poses(source, changed, chunks, rests)[0]).agrees:
                corrections.append("\n".join(f'{key} = "{value}"' for key, value in change.items()))
    return PhysicalTestResult(
        id=source.id,
        agrees=fit.agrees,
        deviations_deg=(one, two, three),
        found=explain_frames(received),
        rig_toml=tuple(corrections[:1]),
        alternatives=tuple(corrections[1:]),
    )


def _other_settings(settings: Any) -> list[dict[str, str]]:
    """Return other values of the keys for frames, those with the fewest changes first."""
    fields = type(settings).model_fields
    choices = {key: get_args(fields[key].annotation) for key in _KEYS if key in fields}
    all_values = [dict(zip(choices, values, strict=True)) for values in product(*choices.values())]
    changes = [
        {key: value for key, value in each.items() if value != getattr(settings, key)}
        for each in all_values
    ]
    return sorted((change for change in changes if change), key=len)


def _poses(
    source: Source, settings: Any, chunks: Sequence[Chunk], rests: Sequence[tuple[int, int]]
) -> tuple[Array, Array]:
    """Return mean canonical and mean received quaternions at rest, each of shape (4, 4)."""
    decoder = source.driver_class(settings).decoder()
    canonical: list[list[Quaternion]] = [[] for _ in rests]
    received: list[list[Quaternion]] = [[] for _ in rests]
    for chunk in chunks:
        for item in decoder.feed(chunk):
            if not isinstance(item, ImuSample):
                continue
            for number, (begin_ns, end_ns) in enumerate(rests):
                if begin_ns <= item.arrival_ns <= end_ns:
                    canonical[number].append(item.q_world_sensor)
                    received[number].append(item.q_native)

    means = [rotation.average(np.array(poses)) for poses in canonical]
    native = [rotation.average(rotation.normalize(np.array(poses))) for poses in received]
    return np.array(means), np.array(native)
