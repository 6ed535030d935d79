"""Start of an Xbus device: the driver makes it measure, or raises an error with the cause.

The driver reads the stored configuration of the device. It changes a setting only if the difference
matters and ``persist`` permits the change, because an Xbus device stores every setting in flash at
once. A fault that may end without a change of the settings raises `DeviceLostError`. All other
faults raise `DeviceMisconfiguredError`.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NoReturn

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.silence import find_other_speed
from jointfit_drivers.xbus import _sync_lines
from jointfit_drivers.xbus._conversation import OUTSTANDING_S, XbusConversation
from jointfit_drivers.xbus._required_outputs import ORIENTATION, required_outputs
from jointfit_protocols.xbus import XbusMessage, XbusMessageId, mtdata
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item, real_id

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort
    from jointfit_drivers.xbus._required_outputs import RequiredOutput
    from jointfit_drivers.xbus._settings import XbusSettings
    from jointfit_protocols.orientation import World

log = logging.getLogger(__name__)

LINE_SPEEDS = (921_600, 115_200, 460_800, 230_400, 2_000_000, 57_600, 38_400, 19_200, 9_600)
"""Line speeds for the search, bit/s: factory settings and usual speeds first."""
_LISTEN_S = 0.15
"""Duration of the search at each speed, s. An acknowledgement takes 10 ms at 9600 baud."""
_QUIET_S = 1.2
"""Time without a byte after which the earlier bytes count as noise, s. It is longer than one
second, because a device that is not an Xbus device may send only once a second."""
_RESETS, _RESET_WAIT_S = 50, 0.1
"""Number of requests after a reset, and the interval between them, s. An MTi-G-700 that had not
answered before replied 1.8 s after its reset."""
_FRAMES = (0, 1)
"""Numbers of the two coordinate frames that alignment rotations refer to: sensor and local."""
_UNKNOWN_MESSAGE = b"\x04"
"""Error code that a device sends for an unknown message."""
_RATE_SHARE = 0.01
"""Largest accepted relative difference between `rate_hz` and the rate of an older device (a device
that sends MTData). Such a device rounds its sample period."""
_NO_SYNC = bytes(12)
"""Entry for a sync function that is off. A request without data would only read the settings."""


class XbusHandshake:
    """Brings one device into measurement mode.

    Parameters
    ----------
    port, emit : SerialPort, Emit
        Open port, and function that receives the device's bytes.
    settings : XbusSettings
        Table of the device in rig.toml.
    hunt : bool
        Whether to search for a silent device at other speeds. If the device's bytes cannot be
        decoded, the other speeds are always searched.
    """

    def __init__(
        self, port: SerialPort, emit: Emit, settings: XbusSettings, *, hunt: bool = True
    ) -> None:
        self._port = port
        self._settings = settings
        self._hunt = hunt
        self._conversation = XbusConversation(port, emit)
        self._path = settings.port
        self._product_code = ""
        self._triggers = tuple(map(Item, _sync_lines.trigger_wires(settings.sync or ())))
        self._needs = required_outputs(settings.orientation, magnetometer=settings.magnetometer)

    async def ensure_measuring(self) -> None:
        """Return when the device measures with the configured settings.

        Raises
        ------
        DeviceLostError
            The device does not answer, was unplugged, or stopped answering.
        DeviceMisconfiguredError
            The device uses another speed or is not an Xbus device. Or the output configuration
            differs and must not be written.
        """
        settings = self._settings
        settings.require_line_speed()

        self._conversation.reset()
        entered = await self._conversation.enter_config(
            late_s=OUTSTANDING_S, late_if_silent=self._hunt
        )
        if not entered and settings.reset_if_stuck and self._conversation.understood:
            log.warning("%s: streams but does not answer; resetting it", settings.id)
            await self._conversation.send(XbusMessageId.RESET)
            entered = await self._conversation.enter_config(tries=_RESETS, wait_s=_RESET_WAIT_S)
        if not entered:
            await self._explain_silence()

        # The decoder reports these properties. Only the device id is required.
        await self._answer(XbusMessageId.REQ_DEVICE_ID)
        for mid in (
            XbusMessageId.REQ_PRODUCT_CODE,
            XbusMessageId.REQ_FIRMWARE,
            XbusMessageId.FILTER_PROFILE,
        ):
            # The reply is emitted. Older devices refuse some of these requests.
            reply = await self._conversation.request(mid)
            if reply is not None and reply.mid == XbusMessageId.PRODUCT_CODE:
                self._product_code = setup.decode_text(reply.data)
        for frame in _FRAMES:
            await self._conversation.request(XbusMessageId.ALIGNMENT_ROTATION, bytes((frame,)))

        if settings.format == "mtdata":
            await self._check_legacy()
        else:
            await self._ensure_outputs()
            await self._ensure_sync()
        reply = await self._answer(XbusMessageId.GOTO_MEASUREMENT)
        self._refuse_error(reply, "refuses to start measuring")

    async def _check_legacy(self) -> None:
        """Compare output mode, settings and rate of an older device, without writing."""
        replies = {
            mid: await self._answer(mid)
            for mid in (XbusMessageId.OUTPUT_MODE, XbusMessageId.OUTPUT_SETTINGS)
        }
        for reply in replies.values():
            self._refuse_error(reply, "has no MTData", '`format`: set it to "mtdata2"')
        period = await self._answer(XbusMessageId.PERIOD)
        skip = await self._answer(XbusMessageId.OUTPUT_SKIP)

        mode = mtdata.decode_output_mode(replies[XbusMessageId.OUTPUT_MODE].data)
        stored = mtdata.decode_output_settings(replies[XbusMessageId.OUTPUT_SETTINGS].data)
        found_hz = mtdata.rate_hz(period.data, b"")
        skipped = skip.mid != XbusMessageId.ERROR and any(skip.data)
        faults = legacy_differences(self._settings, mode, stored, found_hz, skipped=skipped)
        if faults:
            raise DeviceMisconfiguredError(
                f"{self._path}: {'; '.join(faults)}: change the settings here, or configure the "
                "device with MT Manager"
            )

    async def _answer(self, mid: int, data: bytes = b"") -> XbusMessage:
        """Return the reply to a request that the device must answer; the reply may be an error."""
        reply = await self._conversation.request(mid, data, tries=3)
        if reply is None:
            raise self._settings.stopped_answering()
        return reply

    async def _ensure_outputs(self) -> None:
        """Configure the required outputs at the requested rate."""
        rate = int(self._settings.rate_hz)
        reply = await self._answer(XbusMessageId.OUTPUT_CONFIGURATION)
        if reply.mid == XbusMessageId.ERROR and reply.data[:1] == _UNKNOWN_MESSAGE:
            raise DeviceMisconfiguredError(
                f"{self._path}: does not support output configurations, so it is an older device: "
                'set format = "mtdata"'
            )
        found = _outputs_of(reply)
        faults = output_differences(found, rate, self._triggers, self._needs)
        if not faults:
            return
        self._refuse_to_write(faults, _rate_hint(found, self._needs))
        log.warning(
            "%s: writing its output configuration: %s", self._settings.id, "; ".join(faults)
        )

        # Raw measurements are in sensor axes. Only an orientation refers to a world.
        world: World = self._settings.world if self._needs is ORIENTATION else "ENU"
        counters = (Item.PACKET_COUNTER, Item.SAMPLE_TIME_FINE, Item.STATUS_WORD)
        wanted = (
            *((item, setup.MAX_RATE) for item in counters),
            *((real_id(need.items[0], world=world), rate) for need in self._needs),
            *((item, setup.MAX_RATE) for item in self._triggers),
        )
        reply = await self._answer(XbusMessageId.OUTPUT_CONFIGURATION, setup.encode_outputs(wanted))

        asked = ", ".join(need.many for need in self._needs)
        self._refuse_error(reply, f"refuses {asked} at {rate} Hz")

        left = output_differences(_outputs_of(reply), rate, self._triggers, self._needs)
        if left:
            hint = _rate_hint(_outputs_of(reply), self._needs)
            raise DeviceMisconfiguredError(
                f"{self._path}: does not accept the requested outputs: {'; '.join(left)}{hint}: "
                "correct `rate_hz`, or update the firmware of the device"
            )

    def _refuse_to_write(self, faults: list[str], hint: str = "") -> None:
        """Raise an error that lists the necessary changes, unless ``persist`` permits them."""
        if not self._settings.persist:
            raise DeviceMisconfiguredError(
                f"{self._path}: {'; '.join(faults)}{hint}: set persist = true once to write "
                "the settings into the device's flash, or configure the device with MT Manager"
            )

    async def _ensure_sync(self) -> None:
        """Configure the sync lines if rig.toml contains any."""
        if self._settings.sync is None:
            return
        asked = _sync_lines.sync_entries(self._settings.sync, self._product_code)
        faults = _sync_lines.sync_differences(await self._stored_sync_settings(), asked)
        if not faults:
            return
        self._refuse_to_write(faults)
        log.warning("%s: writing its sync settings: %s", self._settings.id, "; ".join(faults))

        reply = await self._answer(
            XbusMessageId.SYNC_SETTINGS, setup.encode_sync(asked) or _NO_SYNC
        )
        self._refuse_error(reply, "refuses these sync settings", "`sync`")

        left = _sync_lines.sync_differences(await self._stored_sync_settings(), asked)
        if left:
            raise DeviceMisconfiguredError(
                f"{self._path}: does not accept `sync`: {'; '.join(left)}: change `sync`"
            )

    async def _stored_sync_settings(self) -> tuple[setup.SyncSetting, ...]:
        reply = await self._answer(XbusMessageId.SYNC_SETTINGS)
        self._refuse_error(reply, "has no sync settings", "`sync`: leave it out")
        entries = setup.decode_sync(reply.data) or ()
        return tuple(entry for entry in entries if entry.polarity)  # without entries that are off

    def _refuse_error(
        self, reply: XbusMessage, what: str, change: str = "`rate_hz` or `baud`"
    ) -> None:
        if reply.mid == XbusMessageId.ERROR:
            code = reply.data[0] if reply.data else 0
            raise DeviceMisconfiguredError(
                f"{self._path}: {what} ({setup.error_text(code)}): change {change}"
            )

    async def _explain_silence(self) -> NoReturn:
        """Raise the error for a device that does not answer GoToConfig."""
        received, conversation = self._conversation.received, self._conversation
        if conversation.understood:
            raise DeviceLostError(
                f"{self._path}: streams but does not answer GoToConfig: check the wire from host "
                "to device, or set reset_if_stuck = true"
            )

        speed = await self._other_speed() if self._hunt or received else None
        if speed is not None:
            if await self._listen_at(self._settings.baud):  # on USB, the speed has no effect
                raise DeviceLostError(
                    f"{self._path}: the device answers too late; retrying. If this repeats, check "
                    "its cable, and the load of the gateway"
                )
            raise DeviceMisconfiguredError(
                f"{self._path}: {self._settings.baud} baud, but no message can be decoded; "
                f"the device answers at {speed}: set baud = {speed}"
            )

        if not received:
            raise DeviceLostError(
                f"{self._path}: silent: check its power, and that TX and RX are not swapped"
            )

        await self._listen_at(self._settings.baud, _QUIET_S)
        if not conversation.received:
            raise DeviceLostError(
                f"{self._path}: some bytes of noise, then silence: check its power and cable, and "
                "`port`"
            )
        raise DeviceMisconfiguredError(
            f"{self._path}: the device on this port is not Xbus: it sends bytes, but no Xbus "
            "message at any common speed: correct `port` or `driver`; `jointfit probe` recognizes "
            "the device on a port"
        )

    async def _other_speed(self) -> int | None:
        """Return the speed at which the device answers; None if it does not answer.

        After the search, the device continues to measure.
        """

        async def answers() -> bool:
            answered = await self._conversation.enter_config(tries=1, wait_s=_LISTEN_S)
            if answered:  # wait for the reply: closing the port discards unsent bytes
                await self._conversation.request(XbusMessageId.GOTO_MEASUREMENT)
            return answered

        return await find_other_speed(
            self._port, self._conversation, LINE_SPEEDS, self._settings.baud, answers
        )

    async def _listen_at(self, baud: int, listen_s: float = _LISTEN_S) -> bool:
        self._port.set_baud(baud)
        self._conversation.reset()
        return await self._conversation.enter_config(tries=1, wait_s=listen_s)


def legacy_differences(
    settings: XbusSettings,
    mode: int | None,
    stored: int | None,
    found_hz: float | None,
    *,
    skipped: bool,
) -> list[str]:
    """Return the differences between an older device and the settings; empty if there are none.

    Orientations and the sample counter are required at ``rate_hz``, and no sample may be skipped.
    """
    if mode is None or stored is None:
        return ["it does not report its output mode"]
    try:
        layout = mtdata.MTDataLayout(mode, stored)
    except ValueError as fault:
        return [str(fault)]

    faults = []
    for key, found in (("output_mode", mode), ("output_settings", stored)):
        asked = getattr(settings, key)
        if asked is not None and asked != found:
            faults.append(f"its {key} is 0x{found:X}, not 0x{asked:X}")
    if not layout.items & {Item.QUATERNION, Item.EULER_ANGLES, Item.ROTATION_MATRIX}:
        faults.append("it sends no orientation (output mode 0x0004)")
    if Item.PACKET_COUNTER not in layout.items:
        faults.append("it sends no sample counter (output settings 0x00000001)")
    if skipped:
        faults.append("it leaves samples out (output skip factor): lower its sample rate instead")
    if found_hz is not None and abs(found_hz - settings.rate_hz) > _RATE_SHARE * found_hz:
        faults.append(f"it measures at {found_hz:g} Hz: set rate_hz = {found_hz:.0f}")
    return faults


def output_differences(
    found: tuple[setup.Output, ...],
    rate: int,
    triggers: tuple[Item, ...] = (),
    needs: tuple[RequiredOutput, ...] = ORIENTATION,
) -> list[str]:
    """Return the differences between an output configuration and the required one; empty if none.

    The required outputs are a counter, a fine time, `needs` at `rate` Hz, and the items that report
    edges (`triggers`). Precision, world and additional items do not matter, because the decoder can
    read all of them.
    """
    faults = []
    kinds = {output.data_id & 0xFFF0: output.rate for output in found}
    for item, name in ((Item.PACKET_COUNTER, "packet counter"), (Item.SAMPLE_TIME_FINE, "time")):
        if item not in kinds:
            faults.append(f"it sends no {name} (0x{item:04X})")

    faults += [f"it does not report edges (0x{item:04X})" for item in triggers if item not in kinds]

    for need in needs:
        sent = [kinds[item] for item in need.items if item in kinds]
        if not sent:
            faults.append(f"it sends no {need.one} (0x{need.items[0]:04X})")
        elif rate not in sent:
            faults.append(f"it sends {need.many} at {_hz(sent[0])}, not {rate} Hz")
    return faults


def _outputs_of(reply: XbusMessage) -> tuple[setup.Output, ...]:
    return (setup.decode_outputs(reply.data) or ()) if reply.mid != XbusMessageId.ERROR else ()


def _hz(rate: int) -> str:
    return "its maximum rate" if rate in {0, setup.MAX_RATE} else f"{rate} Hz"


def _rate_hint(found: tuple[setup.Output, ...], needs: tuple[RequiredOutput, ...]) -> str:
    """Return a hint to use the device's rate as `rate_hz`, if this removes all differences."""
    rates = {output.rate for output in found if output.data_id & 0xFFF0 in needs[0].items}
    rate = next(iter(rates), 0)
    if rate in {0, setup.MAX_RATE} or output_differences(found, rate, (), needs):
        return ""
    return f" (or set rate_hz = {rate})"
