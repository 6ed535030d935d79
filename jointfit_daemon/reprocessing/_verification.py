"""Comparison of a replay with the recorded outputs, byte for byte.

If a recording began after the start of the daemon, it contains the configuration, but not the state
of clocks and filters. In this case, orientations are compared with a tolerance after a warm-up, and
the result states this.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.recording import (
    PROGRAM,
    STATE,
    RecordingGap,
    encode_output,
    open_recording,
)
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured
from jointfit_daemon.reprocessing._errors import ReprocessingError
from jointfit_daemon.session_data import interpolate_orientations
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion
    from jointfit_daemon.outputs.recording import RecordedMessage, Recording
    from jointfit_daemon.pipeline.events import Event, Output

WARM_UP_S = 20.0
"""Warm-up of a replay whose recording began after the start of the daemon, s. After this time the
clocks and filters of the replay agree with the clocks and filters of the daemon."""
TOLERANCE_RAD = np.radians(1.0)
"""Largest tolerated angle between recorded and replayed orientations after the warm-up, rad."""
TOLERATED_SHARE = 0.99
"""Smallest fraction of the orientations that must be within the tolerance. Orientations near a lost
frame may differ by more."""
_OUTPUT = "output/"


@dataclass(frozen=True, slots=True)
class Difference:
    """The first output of a replay that differs from the recorded output."""

    t_s: float
    """Time since the beginning of the recording, s."""
    channel: str
    """Kind of output, such as ``output/state``."""
    key: str
    """First key whose value differs, such as ``joints[1].angles[0]``; empty for the whole
    output."""
    recorded: str
    """Recorded value as JSON; ``none`` if the recording has no such output."""
    replayed: str
    """Value in the replay as JSON; ``none`` if the replay has no such output."""

    def text(self) -> str:
        """Return the difference as a sentence."""
        place = f"{self.channel} {self.key}".rstrip()
        return (
            f"first difference at {self.t_s:.3f} s in {place}: recorded {self.recorded:.80}, "
            f"replayed {self.replayed:.80}"
        )


@dataclass(frozen=True, slots=True)
class TolerantComparison:
    """Comparison of orientations with a tolerance, for a replay that cannot be exact."""

    compared: int
    """Number of compared orientations after the warm-up."""
    within: int
    """Number of orientations within the tolerance."""
    median_rad: float
    largest_rad: float

    @property
    def agrees(self) -> bool:
        """Whether enough orientations are within the tolerance."""
        return self.compared > 0 and self.within >= TOLERATED_SHARE * self.compared


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of the comparison of a replay with its recording."""

    seconds: float
    """Duration of the recording, s."""
    compared: dict[str, int]
    """Number of equal outputs by channel."""
    difference: Difference | None = None
    gaps: tuple[str, ...] = ()
    """Missing parts of the recording, one sentence each."""
    until_s: float | None = None
    """Time up to which outputs could be compared, s; None if all could be compared."""
    tolerant: TolerantComparison | None = None
    """Result of the comparison with a tolerance; None if bytes were compared."""
    program: str = PROGRAM
    """Name and version of the daemon that wrote the recording."""

    @property
    def passed(self) -> bool:
        """Whether outputs could be compared and all of them agree."""
        if self.tolerant is not None:
            return self.tolerant.agrees
        return self.difference is None and sum(self.compared.values()) > 0

    def lines(self) -> list[str]:
        """Return the gaps and the result as sentences."""
        return [*(f"the recording has a gap {gap}" for gap in self.gaps), *self.result_lines()]

    def result_lines(self) -> list[str]:
        """Return the result as sentences."""
        found = []
        if self.program != PROGRAM:
            found.append(
                f"the recording was made by {self.program} and replayed by {PROGRAM}: results of "
                "another version can differ"
            )
        if self.tolerant is not None:
            return [*found, *_tolerant_lines(self.tolerant)]

        count = sum(self.compared.values())
        kinds = ", ".join(
            f"{number} {channel.removeprefix(_OUTPUT)}" for channel, number in self.compared.items()
        )
        if self.until_s is not None:
            found.append(
                f"outputs after {self.until_s:.3f} s cannot be compared because of the gap"
            )
        if self.difference is not None:
            found.append(self.difference.text())
        if count == 0:
            return [*found, "no output could be compared"]
        return [*found, f"{count} outputs are equal, byte for byte: {kinds}"]


def _tolerant_lines(found: TolerantComparison) -> list[str]:
    begin = (
        "the recording began after the start of the daemon, so its outputs are compared with a "
        f"tolerance of {np.degrees(TOLERANCE_RAD):g}° after a warm-up of {WARM_UP_S:g} s"
    )
    if found.compared == 0:
        return [begin, "no orientation could be compared: the recording is too short"]
    return [
        begin,
        f"{found.within} of {found.compared} orientations agree; difference: median "
        f"{np.degrees(found.median_rad):.3f}°, largest {np.degrees(found.largest_rad):.3f}°",
    ]


def verify_recording(path: Path) -> Verification:
    """Replay a recording in a new core and compare every recorded output.

    Parameters
    ----------
    path
        Path of the recording. For a session in several parts, the path of any part.

    Raises
    ------
    ReprocessingError
        The recording contains no configuration.
    ConfigError
        The recorded rig cannot be loaded, because a driver is not installed.
    ValueError, OSError
        The file is not a recording, or cannot be read.
    """
    recording = open_recording(path)
    if recording.began_with_daemon:
        return _verify_bytes(recording)
    return _verify_orientations(recording)


@dataclass(slots=True)
class _ByteComparison:
    """Replay of events, and comparison of its outputs with the recorded outputs, in order."""

    begin_ns: int | None = None
    now_ns: int = 0
    expected: deque[tuple[str, bytes]] = field(default_factory=deque)
    compared: dict[str, int] = field(default_factory=dict)

    def feed(self, core: Core, event: Event) -> Difference | None:
        """Process an event; return a difference if an earlier output was not in the recording."""
        if self.expected:
            channel, data = self.expected[0]
            return Difference(self.seconds, channel, "", "none", data.decode("utf-8", "replace"))
        self.now_ns = event.chunk.t_ns if isinstance(event, ChunkArrived) else event.t_ns
        if self.begin_ns is None:
            self.begin_ns = self.now_ns
        encoded = (encode_output(output) for output in core.feed(event))
        self.expected.extend(one for one in encoded if one is not None)
        return None

    def compare(self, message: RecordedMessage) -> Difference | None:
        """Return how a recorded output differs from the next replayed output; None if equal."""
        if not self.expected:
            recorded = message.data.decode("utf-8", "replace")
            return Difference(self.seconds, message.channel, "", recorded, "none")
        channel, data = self.expected.popleft()
        if (channel, data) == (message.channel, message.data):
            self.compared[channel] = self.compared.get(channel, 0) + 1
            return None
        if channel != message.channel:
            return Difference(self.seconds, message.channel, "", message.channel, channel)
        key, recorded, replayed = _first_difference(
            orjson.loads(message.data), orjson.loads(data), ""
        )
        return Difference(self.seconds, channel, key, recorded, replayed)

    @property
    def seconds(self) -> float:
        """Time since the first event, s."""
        return (self.now_ns - (self.begin_ns or 0)) / NS_PER_S


def _verify_bytes(recording: Recording) -> Verification:
    core, comparison = Core(), _ByteComparison()
    difference: Difference | None = None
    gaps: list[str] = []
    until_s: float | None = None
    for item in recording.messages():
        if isinstance(item, RecordingGap):
            gaps.append(_gap_text(item, comparison.begin_ns))
            until_s = comparison.seconds if until_s is None else until_s
            continue
        comparison.now_ns = max(comparison.now_ns, item.t_ns)
        if until_s is not None or difference is not None:
            continue  # only gaps and duration are needed
        if item.channel.startswith(_OUTPUT):
            difference = comparison.compare(item)
        elif (event := item.event()) is not None:
            _check_begins_with_configuration(comparison.begin_ns, event)
            difference = comparison.feed(core, event)
    return Verification(
        comparison.seconds, comparison.compared, difference, tuple(gaps), until_s,
        program=recording.info.program,
    )  # fmt: skip


def _check_begins_with_configuration(begin_ns: int | None, event: Event) -> None:
    if begin_ns is None and not isinstance(event, Configured):
        raise ReprocessingError(
            "the recording does not begin with a configuration: its beginning is missing. "
            "Add the first part of the session"
        )


def _gap_text(gap: RecordingGap, begin_ns: int | None) -> str:
    at_s = (gap.from_t_ns - (begin_ns or gap.from_t_ns)) / NS_PER_S
    return f"at {at_s:.3f} s: {gap.text()}"


def _first_difference(recorded: Any, replayed: Any, key: str) -> tuple[str, str, str]:
    """Return the key of the first value that differs, and both values as JSON."""
    if isinstance(recorded, dict) and isinstance(replayed, dict):
        for name in dict.fromkeys((*recorded, *replayed)):
            one, other = recorded.get(name), replayed.get(name)
            if one != other or (name in recorded) != (name in replayed):
                return _first_difference(one, other, f"{key}.{name}".lstrip("."))
    if isinstance(recorded, list) and isinstance(replayed, list) and len(recorded) == len(replayed):
        for number, (one, other) in enumerate(zip(recorded, replayed, strict=True)):
            if one != other:
                return _first_difference(one, other, f"{key}[{number}]")
    return key, orjson.dumps(recorded).decode(), orjson.dumps(replayed).decode()


# --- recordings that began after the start of the daemon -----------------------------------------


class _Orientations:
    """Collects the orientations of segments and their instants."""

    def __init__(self) -> None:
        self._rows: dict[str, tuple[list[int], list[Quaternion]]] = {}

    def add(self, name: str, t_ns: int, q: Quaternion | None) -> None:
        """Append one orientation if it is known and later than the last one."""
        stamps, rows = self._rows.setdefault(name, ([], []))
        if q is not None and (not stamps or t_ns > stamps[-1]):
            stamps.append(t_ns)
            rows.append(q)

    def add_replayed(self, outputs: Iterable[Output]) -> None:
        """Append the orientations of all limb states among the outputs of the replay."""
        for output in outputs:
            if isinstance(output, LimbState):
                for segment in output.segments:
                    self.add(segment.name, output.t_ns, segment.q_world_segment)

    def arrays(self, begin_ns: int) -> dict[str, tuple[Array, Array]]:
        """Return instants, s, shape (n,), and orientations, shape (n, 4), by segment."""
        return {
            name: ((np.array(stamps, dtype=np.int64) - begin_ns) / NS_PER_S, np.array(rows))
            for name, (stamps, rows) in self._rows.items()
            if rows
        }


def _verify_orientations(recording: Recording) -> Verification:
    """Compare the orientations after the warm-up, which starts again after a gap."""
    core, begin_ns, now_ns, quiet_ns = Core(), None, 0, 0
    gaps: list[str] = []
    recorded, replayed = _Orientations(), _Orientations()
    for item in recording.messages():
        if isinstance(item, RecordingGap):
            gaps.append(_gap_text(item, begin_ns))
            core, quiet_ns = Core(), item.to_t_ns + round(WARM_UP_S * NS_PER_S)
            continue
        now_ns = max(now_ns, item.t_ns)
        if item.channel == STATE:
            state = orjson.loads(item.data)
            if state["t_ns"] >= quiet_ns:
                for segment in state["segments"]:
                    recorded.add(segment["name"], state["t_ns"], segment["q_world_segment"])
        elif (event := item.event()) is not None:
            _check_begins_with_configuration(begin_ns, event)
            if begin_ns is None:
                begin_ns, quiet_ns = item.t_ns, item.t_ns + round(WARM_UP_S * NS_PER_S)
            replayed.add_replayed(core.feed(event))

    begin_ns = begin_ns or 0
    errors = _orientation_errors(recorded.arrays(begin_ns), replayed.arrays(begin_ns))
    found = TolerantComparison(
        errors.size,
        int((errors <= TOLERANCE_RAD).sum()),
        float(np.median(errors)) if errors.size else float("nan"),
        float(errors.max()) if errors.size else float("nan"),
    )
    seconds = (now_ns - begin_ns) / NS_PER_S
    return Verification(seconds, {}, None, tuple(gaps), None, found, recording.info.program)


def _orientation_errors(
    recorded: dict[str, tuple[Array, Array]], replayed: dict[str, tuple[Array, Array]]
) -> Array:
    """Return the angles between recorded and interpolated replayed orientations, rad."""
    found = []
    for name, (t_s, q) in recorded.items():
        if name in replayed:
            other = interpolate_orientations(*replayed[name], t_s)
            angles = rotation.angle_between(q, other)
            found.append(angles[np.isfinite(angles)])
    errors: Array = np.concatenate(found) if found else np.empty(0)
    return errors
