"""One connection to a stream: search, description, samples, and comparisons of the clocks.

1. The session searches for streams that fit the settings. If no stream fits, the device counts as
lost. If streams of several sources fit, the device counts as misconfigured.
2. It emits the description, then the samples as they arrive. Each emission is one chunk.
3. A second thread queries the offset of the sender's clock and emits every new result. It is a
separate thread because the first reply takes half a second.

The inlet of pylsl does not reconnect by itself. After a loss, the session searches for the stream
again, so that it detects a changed description.

Invariant: chunks are emitted in the event loop, in the order of arrival.
"""

from __future__ import annotations

import asyncio
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk
from jointfit_daemon.name_lists import list_names
from jointfit_drivers.lsl_markers._library import compare_clocks, load_library, search_streams
from jointfit_protocols.lsl import (
    FORMATS,
    MOST_CHANNELS,
    encode_description,
    encode_round_trip,
    encode_samples,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jointfit_daemon.driver import Emit
    from jointfit_drivers.lsl_markers._settings import LslMarkersSettings

SEARCH_S = 3.0
"""Time to search for a stream, s."""
_STEP_S = 0.3
"""Longest duration of a blocking library call, s. A cancelled connection ends within this time."""
_DESCRIPTION_S = 5.0
_COMPARE_S = 1.0
"""Interval between queries for a new comparison of the clocks, s."""
_MOST_SAMPLES = 256
"""Largest number of samples in a chunk."""
_BUFFER_S = 10
"""Duration of the samples that the library stores while this host does not read, s."""
_OTHERS = 32
"""Number of streams after which the search for all streams ends, because an error message lists
only some of them."""
_LISTED = 8
"""Largest number of streams in an error message."""
_FORMATS = dict(enumerate(("", "float32", "double64", "string", "int32", "int16", "int8", "int64")))
"""Names of the sample formats of liblsl, by number."""


def _choices(streams: Sequence[Any]) -> str:
    """Return a text that lists several streams that fit, and the keys that distinguish them."""
    values = {
        "stream": [info.name() for info in streams],
        "source_id": [info.source_id() for info in streams],
        "server": [info.hostname() for info in streams],
        "stream_type": [info.type() for info in streams],
    }
    keys = [key for key, found in values.items() if len(set(found)) == len(found)]
    keys = keys or [key for key, found in values.items() if len(set(found)) > 1]
    listed = ", ".join(
        f"{info.name()!r} of {info.hostname()} (source_id {info.source_id()!r})" for info in streams
    )
    remedy = " or ".join(keys) or "predicate"
    return f"{len(streams)} streams fit: {listed}: set {remedy} in [mocap]"


def _other_streams(streams: Sequence[Any]) -> str:
    """Return a remedy for a missing stream, with the streams that the network has."""
    others = [info for info in streams if not info.source_id().startswith("jointfit-")]
    if others:
        listed = list_names(
            [f"{info.name()!r} of {info.hostname()} (type {info.type()!r})" for info in others],
            _LISTED,
        )
        return f"; the network has {listed}: set stream in [mocap] to the stream of the cameras"
    return (
        ": start the program that sends the stream, check its name (`jointfit probe --network` "
        "lists streams), and check that firewalls pass UDP 16571 and TCP 16572 to 16604"
    )


class LslSession:
    """One connection to a stream.

    Parameters
    ----------
    settings : LslMarkersSettings
        The ``[mocap]`` table.
    emit : Emit
        Function that receives every chunk.
    """

    def __init__(self, settings: LslMarkersSettings, emit: Emit) -> None:
        self._settings = settings
        self._emit = emit
        self._loop = asyncio.get_running_loop()
        self._ended: asyncio.Future[None] = self._loop.create_future()
        self._finished = asyncio.Event()
        """Event that is set when the threads have ended."""
        self._stop = threading.Event()
        self._last_ns = 0

    async def run(self) -> None:
        """Connect and read until cancelled. Raises the same errors as `LslMarkersMocap.run`."""
        lsl = load_library()
        reading = threading.Thread(target=self._read, args=(lsl,), name="lsl reader", daemon=True)
        reading.start()
        try:
            await self._ended
        finally:
            self._stop.set()
            await self._finished.wait()

    # --- in the event loop --------------------------------------------------------------------

    def _take(self, arrival_ns: int, data: bytes) -> None:
        if self._ended.done() or self._stop.is_set():
            return
        self._last_ns = max(self._last_ns, arrival_ns)
        try:
            self._emit(Chunk(self._last_ns, data))
        except Exception as error:  # noqa: BLE001 - a callback passes its error to the coroutine
            self._end(error)

    def _end(self, error: Exception) -> None:
        if not self._ended.done():
            self._ended.set_exception(error)

    # --- in threads ---------------------------------------------------------------------------

    def _call(self, function: Callable[..., None], *args: object) -> None:
        """Call a function in the event loop, unless the connection has ended."""
        if not self._stop.is_set():
            self._loop.call_soon_threadsafe(function, *args)

    def _read(self, lsl: Any) -> None:
        """Search for the stream, open it and read it."""
        comparing: threading.Thread | None = None
        inlet: Any = None
        try:
            info = self._find(lsl)
            if info is None:
                return
            inlet = lsl.StreamInlet(info, max_buflen=_BUFFER_S, recover=False)
            kind = self._describe(lsl, inlet)
            comparing = threading.Thread(
                target=self._compare, args=(lsl, inlet), name="lsl clock", daemon=True
            )
            comparing.start()
            self._pull(inlet, kind)
        except lsl.util.LostError:
            self._call(
                self._end,
                DeviceLostError(f"{self._name}: the sender ended the stream: start it again"),
            )
        except Exception as error:  # noqa: BLE001 - a thread passes its error to the coroutine
            self._call(self._end, error)
        finally:
            self._stop.set()
            if comparing is not None:
                comparing.join()
            # The destructor of the inlet closes the sockets. This must happen before the connection
            # counts as ended.
            inlet = None
            with suppress(RuntimeError):  # the event loop is closed
                self._loop.call_soon_threadsafe(self._finished.set)

    @property
    def _name(self) -> str:
        settings = self._settings
        what = settings.stream or settings.source_id or settings.stream_type or settings.predicate
        named = f"LSL stream {what}" if what else "LSL stream of motion capture"
        return f"{named} of {settings.server}" if settings.server else named

    def _find(self, lsl: Any) -> Any:
        """Return the stream that fits the settings; None if the connection was cancelled.

        Raises
        ------
        DeviceLostError
            No stream fits.
        DeviceMisconfiguredError
            Streams of several sources fit.
        """
        settings, until = self._settings, time.monotonic() + SEARCH_S
        while not self._stop.is_set():
            found = search_streams(lsl, settings.query(), settings.server, least=2, wait_s=_STEP_S)
            # A source that restarts may be announced twice. The newest announcement is the valid
            # one. A program may give several streams, even on several PCs, the same source_id.
            newest = {
                (info.source_id() or info.uid(), info.name(), info.type(), info.hostname()): info
                for info in sorted(found, key=lambda info: info.created_at())
            }
            if len(newest) > 1:
                raise DeviceMisconfiguredError(f"{self._name}: {_choices(list(newest.values()))}")
            if newest:
                return next(iter(newest.values()))
            if time.monotonic() > until:
                raise DeviceLostError(
                    f"{self._name}: not found within {SEARCH_S:g} s"
                    + _other_streams(search_streams(lsl, "*", None, least=_OTHERS, wait_s=_STEP_S))
                )
        return None

    def _describe(self, lsl: Any, inlet: Any) -> str:
        """Emit the description, begin to receive, and return the format of the channels.

        After a cancellation, the result has no meaning.

        Raises
        ------
        DeviceLostError
            The sender does not answer.
        DeviceMisconfiguredError
            The stream contains texts, or too many channels.
        """
        info = self._answer(lsl, inlet.info)
        if info is None:
            return ""
        xml = info.as_xml()
        kind = _FORMATS.get(info.channel_format(), "")
        if kind not in FORMATS:
            raise DeviceMisconfiguredError(
                f"{self._name}: the values of {info.name()!r} have the format "
                f"{kind or 'unknown'}, expected numbers: streams of type Markers contain "
                "texts of events; set stream to the stream of the camera software"
            )
        if info.channel_count() > MOST_CHANNELS:
            raise DeviceMisconfiguredError(
                f"{self._name}: {info.channel_count()} channels, expected at most {MOST_CHANNELS}:"
                " remove markers from the stream"
            )
        self._call(self._take, time.monotonic_ns(), encode_description(xml))
        self._answer(lsl, inlet.open_stream)
        return kind

    def _answer(self, lsl: Any, ask: Callable[..., Any]) -> Any:
        """Return the result of a call that waits for the sender; None after cancellation."""
        until = time.monotonic() + _DESCRIPTION_S
        while not self._stop.is_set():
            try:
                return ask(timeout=_STEP_S)
            except lsl.util.TimeoutError:
                if time.monotonic() > until:
                    raise DeviceLostError(
                        f"{self._name}: the sender does not answer within {_DESCRIPTION_S:g} s:"
                        " check that firewalls pass TCP 16572 to 16604, and start the sender again"
                    ) from None
        return None

    def _pull(self, inlet: Any, kind: str) -> None:
        """Emit samples until the connection has ended."""
        silence_s = self._settings.silence_s
        sample_ns = time.monotonic_ns()
        while not self._stop.is_set():
            row, stamp_s = inlet.pull_sample(timeout=min(_STEP_S, silence_s / 4))
            now_ns = time.monotonic_ns()
            if stamp_s is None:
                if now_ns - sample_ns > silence_s * 1e9:
                    raise DeviceLostError(
                        f"{self._name}: no sample for {silence_s:g} s: start streaming in the "
                        "camera software"
                    )
                continue
            sample_ns = now_ns
            rows, stamps_s = inlet.pull_chunk(timeout=0.0, max_samples=_MOST_SAMPLES)
            data = encode_samples(kind, [stamp_s, *stamps_s], [row, *rows])
            self._call(self._take, now_ns, data)

    def _compare(self, lsl: Any, inlet: Any) -> None:
        """Emit every new comparison of the clocks."""
        last_s: float | None = None
        while not self._stop.is_set():
            trip = compare_clocks(lsl, inlet, _STEP_S)
            if trip is not None and trip.remote_s != last_s:
                last_s = trip.remote_s
                self._call(self._take, time.monotonic_ns(), encode_round_trip(trip))
            self._stop.wait(_COMPARE_S if trip is not None else _STEP_S)
