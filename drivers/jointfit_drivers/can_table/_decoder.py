"""Decoder of the can-table driver: records of CAN frames in, samples in SI units out.

A sample is stamped with the first of its frames, because arbitration delays the later ones. Every
record of 24 bytes is a frame of this device, a foreign one, a note of the host, or discarded.

Invariant: the output depends only on the chunks fed; the decoder reads no clock and no bus.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import Corrupt, DeviceEvent
from jointfit_drivers.table_samples import RecordSamples, SampleForm, TableRecord
from jointfit_protocols import can
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.table import CanTable, CanTableCodec

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk, Decoded, TickClock

_REPEAT_NS = 1_000_000_000
"""Shortest interval, ns, between reports of the same error."""
_HALVED = 20
"""Incomplete samples without a complete one after which their order is reported."""


class CanTableDecoder:
    """Decoder of one CAN device.

    Parameters
    ----------
    table : CanTable
        Description of its frames.
    form : SampleForm
        Meaning of their numbers.
    """

    def __init__(self, table: CanTable, form: SampleForm) -> None:
        self._codec = CanTableCodec(table)
        self._samples = RecordSamples(form)
        self._size = can.RECORD_BYTES * len(table.keys)
        self._lost_bytes = 0
        self._error_text = ""
        self._reported_at_ns = 0
        self._never_complete = True

    @property
    def tick_clock(self) -> TickClock | None:
        """Unit and modulus of the device time; None without one."""
        return self._samples.tick_clock

    @property
    def messages(self) -> int:
        """Well-formed frames of this device so far."""
        return self._codec.messages - self._samples.refused

    @property
    def discarded_bytes(self) -> int:
        """Bytes of rejected records, and of lost lines of an adapter."""
        return self._lost_bytes + self._samples.refused_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the content that `chunk` completed, in wire order; never raises."""
        out: list[Decoded] = []
        for item in can.unpack_frames(chunk.data):
            if not isinstance(item, can.CanFrame):
                out.append(self._lose(item.discarded, item.reason))
                continue
            if item.error:
                out += self._error_frame_events(item)
                continue
            sample = self._codec.feed(item)
            if sample is None:
                continue
            if isinstance(sample, CorruptBytes):
                out.append(self._lose(can.RECORD_BYTES, sample.reason))
                continue
            self._never_complete = False
            t_ns, values, data = sample
            out += self._samples.take(TableRecord(t_ns, values, self._size, data))
        if self._never_complete and self._codec.incomplete >= _HALVED:
            self._never_complete = False
            out.append(DeviceEvent("warning", _INCOMPLETE))
        return out

    def flush(self) -> list[Decoded]:
        """Discard an incomplete sample and one that waits for confirmation."""
        self._codec.flush()
        return self._samples.flush()

    def _error_frame_events(self, frame: can.CanFrame) -> list[Decoded]:
        """Return the events of an error frame of the controller, its driver or the host."""
        if frame.can_id == can.HOST_CORRUPT:
            return [self._lose(can.host_count(frame), "no SLCAN line")]
        if frame.can_id == can.HOST_DROPPED:
            lost = can.host_count(frame)
            text = f"this host was too slow: the kernel dropped {lost} CAN frames"
            return [DeviceEvent("warning", text, {"dropped_frames": lost})]

        text, serious = can.describe_error(frame)
        if text == self._error_text and 0 <= frame.t_ns - self._reported_at_ns < _REPEAT_NS:
            return []
        self._error_text, self._reported_at_ns = text, frame.t_ns
        return [DeviceEvent("error" if serious else "warning", text)]

    def _lose(self, count: int, reason: str) -> Corrupt:
        self._lost_bytes += count
        return Corrupt(count, reason)


_INCOMPLETE = (
    f"{_HALVED} samples, and none with all its frames: correct `sequence` if the device sends them "
    "in another order, and `rate_hz`; frames of a sample arrive within half a period"
)
