"""Alignment of sample streams to frames at a fixed rate.

The aligner reads no clock: the caller passes the time to ``advance``. Memory is bounded. Every
frame is emitted once, in order. Every sample has exactly one outcome.

Frame k has the instant ``t_k = k period`` of host CLOCK_MONOTONIC, so the grid does not depend on
the start time. The frame is emitted when every active stream has a sample at or after t_k, or at
the deadline of the frame. Each stream has a deadline: the usual arrival of its next sample plus at
most 1.5 of its periods. The deadline of the frame is the latest deadline of a stream. If a sample
is missing, the orientation of its stream is extrapolated by up to 2.5 periods. Frames later than
this limit do not contain the stream.

Invariant: frames never stop. While no stream has samples, frames without orientations are emitted.
The first of these frames is emitted when every stream counts as lost. Each later frame waits for
the usual delay of the streams. Frames without orientations are skipped only if the whole process
was stopped for more than a second. The caller could not request these frames in time.

In mode ``fast`` a frame is complete if the last sample of each stream precedes t_k by at most one
period of the stream. The orientation is extrapolated to t_k. Frames are therefore emitted up to one
period earlier than in mode ``smooth``, but never before t_k.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - mypyc evaluates the types of fields
from typing import TYPE_CHECKING, Literal, NamedTuple

from jointfit_daemon.timing.alignment._stream import SampleOutcome, Stream

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion, Vector

__all__ = ["AlignedFrame", "FrameAligner", "Mode", "SampleOutcome"]

Mode = Literal["smooth", "fast"]
"""``smooth`` waits for samples and interpolates; ``fast`` extrapolates by at most one period."""

OWED_NS = 1_000_000_000
"""Age, ns, above which frames without orientations are skipped. Without this limit, a process that
was stopped for an hour would emit 360 000 of these frames at 100 Hz.
"""


class AlignedFrame(NamedTuple):
    """All streams at one instant."""

    t_ns: int
    completed_ns: int
    """Arrival of the sample that completed the frame, or the deadline of the frame, ns."""
    orientations: Mapping[str, Quaternion]
    """Orientation of every stream that is not missing, in the order of the streams."""
    extrapolated: frozenset[str]
    missing: frozenset[str]
    synced: bool
    """Whether the clocks of all `orientations` have settled. A frame without orientations repeats
    the value of the last frame with orientations. After all streams have ended, it is False.
    """


_NONE: frozenset[str] = frozenset()


class FrameAligner:
    """Aligns streams of orientations to frames.

    Parameters
    ----------
    streams : mapping of str to int
        Nominal sample period of each stream by id, ns, in the order of the output.
    period_ns : int
        Frame period, ns.
    mode : {"smooth", "fast"}
        ``smooth`` waits for samples, ``fast`` extrapolates.
    begin_ns : int, optional
        Instant from which frames are emitted, even without samples, ns; by default the instant of
        the first sample.

    Raises
    ------
    ValueError
        A period is not positive.
    """

    def __init__(
        self,
        streams: Mapping[str, int],
        period_ns: int,
        *,
        mode: Mode = "smooth",
        begin_ns: int | None = None,
    ) -> None:
        if period_ns <= 0 or any(period <= 0 for period in streams.values()):
            raise ValueError("periods must be positive")
        self._streams = {name: Stream(period) for name, period in streams.items()}
        self._items = tuple(self._streams.items())
        self._period_ns = period_ns
        self._fast = mode == "fast"
        self._next = None if begin_ns is None else -(-begin_ns // period_ns)
        """Number k of the next frame; None before the first sample."""
        self._served: int | None = None  # number k of a frame that has data
        self._serves_ns: int | None = None
        """First instant, from the next frame on, for which a stream has data, ns."""
        self._completed_ns = 0
        self._synced = False
        """Whether the clocks of the last frame had settled."""
        self._deadline_ns: int | None = None
        self._changed = True  # whether `_deadline_ns` must be computed again
        self._dues: dict[str, int] = {}
        """Host time at which each stream is ready for the next frame, ns; empty if not computed.
        """
        self.skipped_frames = 0
        """Number of skipped frames; ``OWED_NS`` defines when a frame is skipped."""

    # --- samples -----------------------------------------------------------------------------

    def push(
        self,
        name: str,
        t_ns: int,
        arrival_ns: int,
        q: Quaternion,
        *,
        synced: bool = True,
        epoch: int = 0,
        rate: Vector | None = None,
    ) -> SampleOutcome | None:
        """Add a sample; return the outcome of the sample if the outcome is already known.

        Parameters
        ----------
        name : str
            Id of the stream. An unknown id raises KeyError.
        t_ns, arrival_ns : int
            Host time of the sampling instant and of the arrival, ns.
        q : Quaternion
            Unit quaternion of either sign.
        synced : bool
            Whether the clock of the stream has settled.
        epoch : int
            Epoch of the clock of the stream; samples of different epochs are not combined.
        rate : Vector, optional
            Measured angular rate at `t_ns` in the sensor's own frame, rad/s.
        """
        stream = self._streams[name]
        self._changed = True
        if epoch != stream.epoch:  # a new epoch: the stream discards its samples
            self._served = None

        passed_ns = None if self._next is None else (self._next - 1) * self._period_ns
        outcome = stream.push(
            t_ns, arrival_ns, q, synced=synced, epoch=epoch, passed_ns=passed_ns, rate=rate
        )
        if self._dues:  # the other streams are unchanged
            self._dues[name] = self._due_of(stream)
        return outcome

    def counts(self, name: str) -> dict[str, int]:
        """Return the number of received samples, of samples by outcome, and of pending samples."""
        return self._streams[name].counts()

    # --- frames ------------------------------------------------------------------------------

    @property
    def next_deadline_ns(self) -> int | None:
        """Host time at which ``advance`` emits a frame even if no sample arrives, ns.

        It is None while the instant of the first frame is unknown.
        """
        if self._changed:
            self._deadline_ns = self._due()
            self._changed = False
        return self._deadline_ns

    @property
    def next_ns(self) -> int | None:
        """Instant of the next frame, ns; None while the instant of the first frame is unknown."""
        return None if self._next is None else self._next * self._period_ns

    def advance(self, now_ns: int, *, complete_only: bool = False) -> list[AlignedFrame]:
        """Return the frames due at `now_ns`, in order.

        Parameters
        ----------
        now_ns : int
            Host instant, ns.
        complete_only : bool
            Return no frame that lacks a sample, even after the deadline of the frame. The option is
            for calls between two reads of the devices. After a stall of the process the kernel
            usually has the missing sample in a buffer.
        """
        frames: list[AlignedFrame] = []
        while (due_ns := self.next_deadline_ns) is not None and due_ns <= now_ns:
            if complete_only and self._lacks_sample():
                break
            self._changed = True
            if self._served == self._next or not self._pass_over(now_ns):
                frames.append(self._emit(due_ns))
        return frames

    def _lacks_sample(self) -> bool:
        """Return whether an expected stream lacks the sample that completes the next frame."""
        t_k = (self._next or 0) * self._period_ns
        return any(
            stream.waited_for and stream.newest_ns < (t_k - stream.period_ns if self._fast else t_k)
            for _, stream in self._items
        )

    def _pass_over(self, now_ns: int) -> bool:
        """Skip old frames without data; return False if no frame was skipped."""
        until_ns = now_ns - OWED_NS
        if self._serves_ns is not None:
            until_ns = min(until_ns, self._serves_ns)
        first, following = -(-until_ns // self._period_ns), self._next or 0
        if first <= following:
            return False
        self.skipped_frames += first - following
        self._next = first
        return True

    def _find_servers(self) -> None:
        """Find the first instant, from the next frame on, for which a stream has data.

        Streams that have ended are reset.
        """
        starts: list[int] = []
        t_next, served = self.next_ns, False
        for _, stream in self._items:
            if served and stream.waited_for:
                continue  # one stream with data is sufficient, and this stream has not ended
            start = stream.serves_from(t_next)
            if start is None:
                stream.settle()
            else:
                starts.append(start)
                served = served or start == t_next

        self._serves_ns = min(starts, default=None)
        if served:
            self._served = self._next
        elif self._next is None and self._serves_ns is not None:
            self._next = self._served = -(-self._serves_ns // self._period_ns)

    def _due(self) -> int | None:
        """Return the time at which the next frame is complete, or its deadline, ns."""
        if self._served is None or self._served != self._next:
            self._dues.clear()
            self._find_servers()
        t_k = self.next_ns
        if t_k is None:
            return None
        if self._served != self._next:
            return max([t_k, *[stream.latest_wait_ns(t_k) for _, stream in self._items]])
        if not self._dues:  # otherwise each sample updates only the due time of its own stream
            self._dues = {name: self._due_of(stream) for name, stream in self._items}
        latest = max(self._dues.values())
        return max(t_k, latest) if self._fast else latest

    def _due_of(self, stream: Stream) -> int:
        t_k = (self._next or 0) * self._period_ns
        return stream.due(t_k - stream.period_ns if self._fast else t_k)

    def _emit(self, due_ns: int) -> AlignedFrame:
        number = self._next or 0
        t_k = number * self._period_ns
        self._next = number + 1
        self._completed_ns = completed_ns = max(self._completed_ns, due_ns)

        orientations: dict[str, Quaternion] = {}
        extrapolated: list[str] = []
        missing: list[str] = []
        synced = True
        for name, stream in self._items:
            q = stream.at(t_k)
            if q is None:
                missing.append(name)
                continue
            orientations[name] = q
            synced = synced and stream.synced
            if stream.extrapolated:
                extrapolated.append(name)

        # Clocks remain settled during a pause, so the value is unchanged until all streams have
        # ended.
        if not orientations:
            synced = self._synced and any(stream.waited_for for _, stream in self._items)

        self._synced = synced
        return AlignedFrame(
            t_k,
            completed_ns,
            orientations,
            frozenset(extrapolated) if extrapolated else _NONE,
            frozenset(missing) if missing else _NONE,
            synced,
        )

    # --- control -----------------------------------------------------------------------------

    def lose(self, name: str) -> None:
        """Mark a stream as ended; frames do not wait for it until its next sample."""
        self._streams[name].lose()
        self._changed, self._served = True, None

    def reset(self, name: str) -> None:
        """Discard the samples of a stream whose clock restarted."""
        self._streams[name].reset()
        self._changed, self._served = True, None

    def close(self) -> None:
        """Remove every pending sample and count its outcome; later samples restart the streams."""
        for _, stream in self._items:
            stream.reset()
        self._changed, self._served = True, None
