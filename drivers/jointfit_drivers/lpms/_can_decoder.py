"""Decoder of LPMS sensors on CAN: converts records of CAN frames to samples.

The sensor sends no time and no sequence number. The stamp of a sample is the arrival of its first
frame, and losses are detected from the arrivals.

A chunk contains records of 24 bytes. A record contains a CAN frame, an error frame of the
controller, or the number of frames or bytes that this host lost.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no bus.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_daemon.units import NS_PER_S
from jointfit_drivers.bus_events import BusEvents
from jointfit_drivers.lpms._arrival_gaps import ArrivalGaps
from jointfit_drivers.lpms._orientation import LpmsConvention, LpmsOrientation
from jointfit_protocols import can
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.lpms import unit_of
from jointfit_protocols.lpms.channels import (
    BOOTED,
    FRAMES,
    OPERATIONAL,
    ChannelQuaternion,
    Heartbeat,
    LpmsCanCodec,
    decode_frame,
    encode_frames,
)

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_drivers.lpms._can_settings import LpmsCanSettings

_TORN = 20
"""Number of consecutive frames of incomplete quaternions after which a warning names the order of
the frames as the cause."""


class LpmsCanDecoder:
    """Decoder of one LPMS sensor on CAN.

    Parameters
    ----------
    settings : LpmsCanSettings
        Table of the device in rig.toml.
    """

    tick_clock = None
    """None, because the sensor sends no time."""

    def __init__(self, settings: LpmsCanSettings) -> None:
        self._codec = LpmsCanCodec(
            settings.channel_ids,
            settings.precision,
            settings.mapping,
            longest_ns=round(NS_PER_S / settings.rate_hz / 2),
        )
        self._floats = settings.precision == "float32"
        self._rate_hz = settings.rate_hz
        self._gaps = ArrivalGaps(settings.rate_hz)
        self._orientation = LpmsOrientation(LpmsConvention.of(settings), _NORM_REMEDY)
        self._is_mapped = settings.mapping != _PLAIN
        self._incomplete = self._torn = self._refused = 0
        self._state: int | None = None
        self._bus = BusEvents()

    @property
    def messages(self) -> int:
        """Number of well-formed frames received from this sensor."""
        return self._codec.messages - self._refused

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes in rejected records, plus adapter bytes that formed no frame."""
        return self._bus.discarded_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples and events that `chunk` completes, in wire order; never raise."""
        out: list[Decoded] = []
        for item in can.unpack_frames(chunk.data):
            if not isinstance(item, can.CanFrame):
                out.append(self._bus.discard(item.discarded, item.reason))
            elif item.error:
                if item.can_id in {can.HOST_CORRUPT, can.HOST_DROPPED}:
                    # Frames may be missing here, so the frames before and after may belong to
                    # different samples.
                    out += self.flush()
                out += self._bus.add_error_frame(item)
            else:
                found = self._codec.feed(item)
                if self._codec.incomplete != self._incomplete:
                    self._report_incomplete(out)
                if isinstance(found, ChannelQuaternion):
                    self._torn = 0
                    self._sample(found, out)
                elif isinstance(found, Heartbeat):
                    self._heartbeat(found, out)
                elif isinstance(found, CorruptBytes):
                    out.append(self._bus.discard(can.RECORD_BYTES, found.reason))
        return out

    def flush(self) -> list[Decoded]:
        """Discard an incomplete quaternion, and return the events that result."""
        self._codec.flush()
        out: list[Decoded] = []
        self._report_incomplete(out)
        return out

    def _sample(self, quaternion: ChannelQuaternion, out: list[Decoded]) -> None:
        """Append the sample of a complete quaternion."""
        step = self._gaps.add(quaternion.t_ns)
        if step.rate_hz is not None:
            text = (
                f"the sensor sends at {step.rate_hz:.4g} Hz, expected {self._rate_hz:g}: set "
                "`rate_hz`, or change the rate of the sensor with LpmsControl"
            )
            out.append(DeviceEvent("warning", text, {"rate_hz": round(step.rate_hz, 2)}))
        if step.lost:
            out.append(DeviceEvent("gap", f"{step.lost} samples lost", {"lost": step.lost}))

        converted = self._orientation.convert(quaternion.values, floats=self._floats)
        if self._orientation.events:
            out += self._orientation.events
            self._orientation.events = []
        if converted is None:
            self._refused += 1
            if self._floats and not self._is_mapped:
                # The bytes that were decoded as floats may be a quaternion of 16-bit integers.
                floats = [*quaternion.values, *[0.0] * 4]
                frame = encode_frames(range(FRAMES), floats, "float32")[0]
                if unit_of(decode_frame(frame.data, "int16") or ()) is not None:
                    self._orientation.remedy = 'the data fit precision = "int16"'
            out.append(self._bus.discard(can.RECORD_BYTES, "quaternion norm is not 1", rejected=1))
            return
        native, q = converted
        out.append(ImuSample(quaternion.t_ns, q, native, None, None))

    def _heartbeat(self, beat: Heartbeat, out: list[Decoded]) -> None:
        """Append an event if the state of the sensor has changed."""
        before, self._state = self._state, beat.state
        if beat.state == before:
            return
        if beat.state == BOOTED:
            self._orientation.forget()
            out.append(DeviceEvent("restart", "device restarted (its heartbeat reports a start)"))
        elif beat.state != OPERATIONAL:
            text = (
                f"the heartbeat of the sensor reports state {beat.state}, expected {OPERATIONAL} "
                "(operational): switch its CAN output on with LpmsControl"
            )
            out.append(DeviceEvent("warning", text, {"state": beat.state}))

    def _report_incomplete(self, out: list[Decoded]) -> None:
        """Append events if the codec discarded frames because their quaternion is incomplete."""
        count = self._codec.incomplete - self._incomplete
        self._incomplete += count
        if not count:
            return
        self._refused += count
        out.append(
            self._bus.discard(
                count * can.RECORD_BYTES, "frame of an incomplete quaternion", rejected=count
            )
        )

        before, self._torn = self._torn, self._torn + count
        if before < _TORN <= self._torn:
            out.append(DeviceEvent("warning", _OUT_OF_ORDER))


_PLAIN = (1, 2, 3, 4)
"""Channels of w, x, y and z, in the usual order of the frames."""
_NORM_REMEDY = "change `precision` or `mapping`, and remove `scale`"
_OUT_OF_ORDER = (
    "the frames of a quaternion do not follow each other within half a period: set `rate_hz` to "
    "the rate of the sensor, and set ascending identifiers with LpmsControl and in `ids`; "
    'precision = "int16" needs one frame only'
)
