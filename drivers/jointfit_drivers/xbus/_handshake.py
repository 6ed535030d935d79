"""From an open port to a measuring Xbus device, or to words that say why not.

Law: what the device has stored is read and compared, and changed only where it differs in a way
that matters and ``persist`` allows it, for every set of an Xbus device is stored in flash at once.
What can heal is DeviceLostError, what cannot is DeviceMisconfiguredError.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NoReturn

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.xbus import _sync_lines
from jointfit_drivers.xbus._conversation import OUTSTANDING_S, Conversation
from jointfit_drivers.xbus._required_outputs import ORIENTATION, message_bytes, needs_of
from jointfit_protocols.xbus import MessageId, XbusMessage
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item, real_id

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort
    from jointfit_drivers.xbus._required_outputs import Need
    from jointfit_drivers.xbus._settings import XbusSettings
    from jointfit_protocols.orientation import World

log = logging.getLogger(__name__)

_OTHER_SPEEDS = (921_600, 115_200, 460_800, 230_400, 2_000_000, 57_600, 38_400, 19_200, 9_600)
"""Factory settings and common choices first."""
_LISTEN_S = 0.15  # an acknowledgement takes 10 ms at 9600 baud, a sample at 10 Hz 100 ms
_RESETS, _RESET_WAIT_S = 50, 0.1  # 5 s: a stuck MTi-G-700 answered 1.8 s after its reset
_BITS = 10  # of one byte on the line, 8N1
_FRAMES = (0, 1)  # of the alignment rotations: sensor, local
_NO_SYNC = bytes(12)  # an entry that is off: a request without data would only ask


class Handshake:
    """Brings one device to measure.

    Parameters
    ----------
    port, emit
        Open port; where what the device says goes.
    settings
        Its table of rig.toml.
    hunt
        Whether to look for the device at other speeds where it is silent at its own. Where bytes
        come but mean nothing it is looked for anyway.
    """

    def __init__(
        self, port: SerialPort, emit: Emit, settings: XbusSettings, *, hunt: bool = True
    ) -> None:
        self._port = port
        self._settings = settings
        self._hunt = hunt
        self._talk = Conversation(port, emit)
        self._who = f"{settings.id} ({settings.port})"
        self._product_code = ""
        self._triggers = tuple(map(Item, _sync_lines.wires(settings.sync or ())))
        self._needs = needs_of(settings)

    async def ensure_measuring(self) -> None:
        """Return when the device measures as the settings ask.

        Raises
        ------
        DeviceLostError
            Silent, unplugged, or it stopped answering.
        DeviceMisconfiguredError
            Another speed, another kind of device, or an output configuration that differs and may
            not be written.
        """
        self._refuse_too_much_for_the_line()
        self._talk.begin_anew()
        if not await self._ensure_config():
            await self._explain_silence()
        await self._read_identity()
        await self._ensure_outputs()
        await self._ensure_sync()
        await self._start()

    def _refuse_too_much_for_the_line(self) -> None:
        settings = self._settings
        needs = settings.rate_hz * message_bytes(self._needs) * _BITS
        if needs > settings.baud:
            raise DeviceMisconfiguredError(
                f"{self._who}: {settings.rate_hz:g} Hz need {needs:g} bit/s, baud = "
                f"{settings.baud}: lower `rate_hz`, or raise the speed of the device and `baud`"
            )

    async def _ensure_config(self) -> bool:
        """Return whether the device is in configuration mode."""
        if await self._talk.enter_config(late_s=OUTSTANDING_S, late_if_silent=self._hunt):
            return True
        if not self._settings.reset_if_stuck or not self._talk.understood:
            return False
        log.warning("%s: streams but does not answer; resetting it", self._who)
        await self._talk.send(MessageId.RESET)
        return await self._talk.enter_config(tries=_RESETS, wait_s=_RESET_WAIT_S)

    async def _read_identity(self) -> None:
        """Ask for what the decoder hands on as information; only the id is owed."""
        await self._answer(MessageId.REQ_DEVICE_ID)
        for mid in (MessageId.REQ_PRODUCT_CODE, MessageId.REQ_FIRMWARE, MessageId.FILTER_PROFILE):
            reply = await self._talk.ask(mid)  # it is emitted; older devices refuse some
            if reply is not None and reply.mid == MessageId.PRODUCT_CODE:
                self._product_code = setup.decode_text(reply.data)
        for frame in _FRAMES:
            await self._talk.ask(MessageId.ALIGNMENT_ROTATION, bytes((frame,)))

    async def _answer(self, mid: int, data: bytes = b"") -> XbusMessage:
        """Return the reply to a request the device owes an answer, which may be an error."""
        reply = await self._talk.ask(mid, data, tries=3)
        if reply is None:
            raise DeviceLostError(f"{self._who}: stopped answering during configuration")
        return reply

    async def _ensure_outputs(self) -> None:
        """Have the device send what is needed, at the rate asked for."""
        rate = int(self._settings.rate_hz)
        reply = await self._answer(MessageId.OUTPUT_CONFIGURATION)
        found = _outputs_of(reply)
        faults = differences(found, rate, self._triggers, self._needs)
        if not faults:
            return
        self._refuse_to_write(faults, _rate_hint(found, self._needs))
        log.warning("%s: writing its output configuration: %s", self._who, "; ".join(faults))
        wanted = (
            (Item.PACKET_COUNTER, setup.MAX_RATE),
            (Item.SAMPLE_TIME_FINE, setup.MAX_RATE),
            (Item.STATUS_WORD, setup.MAX_RATE),
            *((real_id(need.items[0], world=self._world(need)), rate) for need in self._needs),
            *((item, setup.MAX_RATE) for item in self._triggers),
        )
        reply = await self._answer(MessageId.OUTPUT_CONFIGURATION, setup.encode_outputs(wanted))
        asked = ", ".join(need.many for need in self._needs)
        self._refuse_error(reply, f"refuses {asked} at {rate} Hz")
        left = differences(_outputs_of(reply), rate, self._triggers, self._needs)
        if left:
            hint = _rate_hint(_outputs_of(reply), self._needs)
            raise DeviceMisconfiguredError(
                f"{self._who}: cannot do as asked: {'; '.join(left)}{hint}"
            )

    def _world(self, need: Need) -> World:
        """Return the world an item is asked in: raw readings are in the sensor's own axes."""
        return self._settings.world if need.items[0] == Item.QUATERNION else "ENU"

    def _refuse_to_write(self, faults: list[str], hint: str = "") -> None:
        """Say what would have to be written, unless it may be."""
        if not self._settings.persist:
            raise DeviceMisconfiguredError(
                f"{self._who}: {'; '.join(faults)}{hint}: set persist = true once to write it "
                "into the device's flash, or configure the device with the vendor's tool"
            )

    async def _ensure_sync(self) -> None:
        """Have the sync lines do what is asked of them; nothing asked leaves them alone."""
        if self._settings.sync is None:
            return
        asked = _sync_lines.wanted(self._settings.sync, self._product_code)
        faults = _sync_lines.differences(await self._sync_stored(), asked)
        if not faults:
            return
        self._refuse_to_write(faults)
        log.warning("%s: writing its sync settings: %s", self._who, "; ".join(faults))
        reply = await self._answer(MessageId.SYNC_SETTINGS, setup.encode_sync(asked) or _NO_SYNC)
        self._refuse_error(reply, "refuses these sync settings", "`sync`")
        left = _sync_lines.differences(await self._sync_stored(), asked)
        if left:
            raise DeviceMisconfiguredError(
                f"{self._who}: cannot do as `sync` asks: {'; '.join(left)}: change `sync`"
            )

    async def _sync_stored(self) -> tuple[setup.SyncSetting, ...]:
        reply = await self._answer(MessageId.SYNC_SETTINGS)
        self._refuse_error(reply, "has no sync settings", "`sync`: leave it out")
        entries = setup.decode_sync(reply.data) or ()
        return tuple(entry for entry in entries if entry.polarity)  # those that are off are none

    async def _start(self) -> None:
        reply = await self._answer(MessageId.GOTO_MEASUREMENT)
        self._refuse_error(reply, "does not start to measure")

    def _refuse_error(
        self, reply: XbusMessage, what: str, change: str = "`rate_hz` or `baud`"
    ) -> None:
        if reply.mid == MessageId.ERROR:
            code = reply.data[0] if reply.data else 0
            raise DeviceMisconfiguredError(
                f"{self._who}: {what} ({setup.error_text(code)}): change {change}"
            )

    async def _explain_silence(self) -> NoReturn:
        """Raise what fits a device that does not answer GoToConfig."""
        heard, talk = self._talk.heard, self._talk
        if talk.understood:
            raise DeviceLostError(
                f"{self._who}: streams but does not answer GoToConfig: check the wire from host "
                "to device, or set reset_if_stuck = true"
            )
        speed = await self._other_speed() if self._hunt or heard else None
        if speed is not None and await self._listen_at(self._settings.baud):  # USB has no speed
            raise DeviceLostError(f"{self._who}: answered too late; asking again")
        if speed is not None:
            raise DeviceMisconfiguredError(
                f"{self._who}: {self._settings.baud} baud but nothing decodes; "
                f"the device answers at {speed}: set baud = {speed}"
            )
        if not heard:
            raise DeviceLostError(
                f"{self._who}: silent: check its power, and that TX and RX are not swapped"
            )
        await self._listen_at(self._settings.baud)
        if not talk.heard:
            raise DeviceLostError(f"{self._who}: {heard} bytes of noise, then silence")
        raise DeviceMisconfiguredError(
            f"{self._who}: what answers on this port is not an Xbus device: {heard} bytes, none "
            "of them Xbus at any usual speed: set `port` to the right one, or `driver`"
        )

    async def _other_speed(self) -> int | None:
        """Return the speed at which the device talks; it is left measuring as it was."""
        for baud in _OTHER_SPEEDS:
            if baud == self._settings.baud:
                continue
            try:
                answered = await self._listen_at(baud)
            except DeviceMisconfiguredError:  # the port cannot run at it
                continue
            if answered:  # and wait: closing the port throws away what was not sent yet
                await self._talk.ask(MessageId.GOTO_MEASUREMENT)
            if answered or self._talk.understood:
                return baud
        return None

    async def _listen_at(self, baud: int) -> bool:
        self._port.set_baud(baud)
        self._talk.begin_anew()
        return await self._talk.enter_config(tries=1, wait_s=_LISTEN_S)


def differences(
    found: tuple[setup.Output, ...],
    rate: int,
    triggers: tuple[Item, ...] = (),
    needs: tuple[Need, ...] = ORIENTATION,
) -> list[str]:
    """Return in words what an output configuration lacks; empty if it will do.

    It will do with a counter, a fine time, what `needs` says at `rate` Hz and the items that tell
    of edges (`triggers`); precision, world and further items do not matter, for the decoder
    understands them all.
    """
    faults = []
    kinds = {output.data_id & 0xFFF0: output.rate for output in found}
    for item, name in ((Item.PACKET_COUNTER, "packet counter"), (Item.SAMPLE_TIME_FINE, "time")):
        if item not in kinds:
            faults.append(f"it sends no {name} (0x{item:04X})")
    faults += [
        f"it does not tell of edges (0x{item:04X})" for item in triggers if item not in kinds
    ]
    for need in needs:
        sent = [kinds[item] for item in need.items if item in kinds]
        if not sent:
            faults.append(f"it sends no {need.one} (0x{need.items[0]:04X})")
        elif rate not in sent:
            faults.append(f"it sends {need.many} at {_hz(sent[0])}, not {rate} Hz")
    return faults


def _outputs_of(reply: XbusMessage) -> tuple[setup.Output, ...]:
    return (setup.decode_outputs(reply.data) or ()) if reply.mid != MessageId.ERROR else ()


def _hz(rate: int) -> str:
    return "its maximum rate" if rate in {0, setup.MAX_RATE} else f"{rate} Hz"


def _rate_hint(found: tuple[setup.Output, ...], needs: tuple[Need, ...]) -> str:
    """Offer the rate the device has, where that alone would do."""
    rates = {output.rate for output in found if output.data_id & 0xFFF0 in needs[0].items}
    rate = next(iter(rates), 0)
    if rate in {0, setup.MAX_RATE} or differences(found, rate, (), needs):
        return ""
    return f" (or set rate_hz = {rate})"
