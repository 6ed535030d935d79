"""Fuzz targets for serial bytes, CAN frames and UDP datagrams, up to poses and payloads."""

from __future__ import annotations

import struct
from functools import cache
from typing import TYPE_CHECKING

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent
from jointfit_daemon.outputs.mqtt import Outbox
from jointfit_daemon.outputs.payloads import TopicWriter
from jointfit_daemon.outputs.payloads._encoding import encode as encode_payload
from jointfit_daemon.outputs.payloads._health_encoding import core_payload
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, SourceClosed, SourceOpened
from jointfit_daemon.pipeline.sources import SourceState
from jointfit_drivers.bno085 import Bno085Imu, Bno085Settings
from jointfit_drivers.natnet._open_requests import OpenRequests
from jointfit_drivers.qtm import QtmDecoder, QtmSettings
from jointfit_drivers.vicon import ViconDecoder, ViconSettings
from jointfit_drivers.vrpn import VrpnDecoder, VrpnSettings
from jointfit_drivers.witmotion import WitMotionImu, WitMotionSettings
from jointfit_drivers.ximu3 import XImu3Imu, XImu3Settings
from jointfit_protocols import qtm, vicon, vrpn
from jointfit_protocols.bno085 import (
    RVC_BYTES,
    HubReport,
    HubReportId,
    RvcCodec,
    RvcFrame,
    ShtpCodec,
    encode_base_time,
    encode_firmware,
    encode_report,
    encode_rvc,
    encode_shtp,
    encode_status,
)
from jointfit_protocols.can import RECORD_BYTES, CanFrame, pack_frames, unpack_frames
from jointfit_protocols.can.slcan import SlcanCodec
from jointfit_protocols.can.slcan import encode_frame as encode_slcan
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet import HEADER, Bare, NatNetMessageId, decode
from jointfit_protocols.natnet import encode as encode_natnet
from jointfit_protocols.natnet._frame_encode import encode_frame
from jointfit_protocols.witmotion import FRAME_BYTES, WitMotionCodec, WitMotionFrame
from jointfit_protocols.witmotion import encode as encode_witmotion
from jointfit_protocols.xbus import XbusCodec, XbusMessage
from jointfit_protocols.xbus import encode as encode_xbus
from jointfit_protocols.xbus._framing import MAX_DATA
from jointfit_protocols.ximu3 import XImu3Codec
from jointfit_protocols.ximu3 import encode_command as encode_ximu3_command
from jointfit_protocols.ximu3 import encode_data as encode_ximu3
from jointfit_protocols.ximu3 import encode_text as encode_ximu3_text
from tests.drivers.natnet.feeder import INFO, MODEL, frame, marker
from tests.drivers.qtm.feeder import frame as qtm_frame
from tests.drivers.qtm.feeder import xml as qtm_xml
from tests.drivers.vicon.feeder import frame as vicon_frame
from tests.drivers.vicon.feeder import static as vicon_static
from tests.fuzz.target import Target, UnaccountedError
from tests.pipeline.core_feed import (
    BEGIN_NS,
    IDS,
    PERIOD_NS,
    camera_hello,
    table,
    xbus_bytes,
    xcdi_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from jointfit_daemon.config import Rig
    from jointfit_daemon.pipeline.events import Event
    from jointfit_protocols.natnet import Message

VERSIONS = ((2, 5), (2, 11), (3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (0, 0), (99, 99))
ANSWERS = (0x01, 0x0D, 0x13, 0x1D, 0x2D, 0x3E, 0x42, 0x43, 0xC1, 0xED)
"""Identifiers of Xbus messages that a device sends without a request or as answers."""
SIZES = (1, 2, 7, 40, 300, 4096)
"""Sizes of the chunks in which a stream arrives, bytes."""
_MS = 1_000_000
_PAUSE_EVERY = 16
_PAUSE_NS = 700 * _MS
"""Pause after some chunks, ns. It is longer than the largest accepted delay of a source."""


# --- cutting inputs ---------------------------------------------------------------------------


def cut(data: bytes) -> Iterator[bytes]:
    """Split a stream into chunks; the content of the stream determines their sizes."""
    at, state = 0, len(data) * 256 + data[0] if data else 0
    while at < len(data):
        # This is a linear congruential generator, because seeding `random.Random` would cost more
        # time than the case.
        state = (1_103_515_245 * state + 12_345) % 2**31
        size = SIZES[(state >> 16) % len(SIZES)]
        yield data[at : at + size]
        at += size


def records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Split an input into records ``u8 kind, u8 length, payload``; the last one may be short."""
    at = 0
    while at + 2 <= len(data):
        kind, size = data[at], data[at + 1]
        yield kind, data[at + 2 : at + 2 + size]
        at += 2 + size


# --- through the core -------------------------------------------------------------------------


@cache
def rig() -> Rig:
    """Return the rig of `core_feed`."""
    return parse_rig(table())


def feed_core(source: str, chunks: Iterable[bytes]) -> None:
    """Process chunks with decoder, clock, fusion and payloads of the whole core."""
    core, reporter = Core(), TopicWriter(rig(), Outbox("b/bridge/state"), UnixClock())
    t_ns = BEGIN_NS
    events: list[Event] = [Configured(t_ns, rig(), None), SourceOpened(t_ns, source)]
    if source == "mocap":
        events += camera_hello(t_ns)
    for event in events:
        for output in core.feed(event):
            reporter.output(output)

    for number, data in enumerate(chunks):
        t_ns += PERIOD_NS if (number + 1) % _PAUSE_EVERY else _PAUSE_NS
        for output in core.feed(ChunkArrived(source, Chunk(t_ns, data))):
            reporter.output(output)

    encode_payload(core_payload(core.health(t_ns)))
    for output in core.feed(SourceClosed(t_ns, source, "lost", "over")):
        reporter.output(output)


def feed_source(source: str, chunks: Iterable[bytes]) -> None:
    """Process chunks with decoder and clock of one source; convert the events to JSON."""
    (configured,) = (item for item in rig().sources if item.id == source)
    state = SourceState.create(configured)
    state.start()
    t_ns = BEGIN_NS
    for event in camera_hello(t_ns) if source == "mocap" else ():
        if isinstance(event, ChunkArrived):
            state.feed(event.chunk)
    for number, data in enumerate(chunks):
        t_ns += PERIOD_NS if (number + 1) % _PAUSE_EVERY else _PAUSE_NS
        for item in state.feed(Chunk(t_ns, data)):
            if isinstance(item, DeviceEvent):
                encode_payload(item.data)
    state.stop()


# --- serial -----------------------------------------------------------------------------------


def run_xbus_bytes(data: bytes) -> None:
    """Decode serial bytes in pieces; every byte belongs to a message or is counted."""
    decoder, found = XbusCodec(), []
    for piece in cut(data):
        found += decoder.feed(piece)
    found += decoder.flush()
    used = sum(item.size if isinstance(item, XbusMessage) else item.discarded for item in found)
    if used != len(data):
        raise UnaccountedError(f"{len(data)} bytes, {used} in messages or discarded")


def _xbus_messages(data: bytes) -> list[bytes]:
    return [encode_xbus(kind, payload[:MAX_DATA]) for kind, payload in records(data)]


def run_xbus_source(data: bytes) -> None:
    """Put records into valid Xbus messages and take them through decoder and clock."""
    feed_source("S1", _xbus_messages(data))


def run_xbus_core(data: bytes) -> None:
    """Put records into valid Xbus messages and take them through the core."""
    feed_core("S1", _xbus_messages(data))


def run_serial_core(data: bytes) -> None:
    """Take raw serial bytes through the core."""
    feed_core("S1", cut(data))


def seeds_xbus() -> list[bytes]:
    """Return a stream of an Xbus sensor."""
    return [b"".join(xbus_bytes("S1", n) for n in range(count)) for count in (1, 4, 12)]


def seeds_xbus_records() -> list[bytes]:
    """Return measurements, answers and warnings as records."""
    samples = [xbus_bytes("S1", n) for n in (0, 1, 2, 30, 42_949_672)]
    packed = b"".join(bytes((data[2], data[3])) + data[4:-1] for data in samples)
    kinds = [bytes((kind, 6)) + b"\x07MTi-30"[:6] for kind in ANSWERS]
    return [packed, packed + b"".join(kinds), b"".join(kinds)]


def run_bno085_bytes(data: bytes) -> None:
    """Decode BNO085 bytes in pieces, in both modes; every byte is accounted for."""
    rvc, shtp = RvcCodec(), ShtpCodec()
    frames, packets = [], []
    for piece in cut(data):
        frames += rvc.feed(piece)
        packets += shtp.feed(piece)
    frames += rvc.flush()
    packets += shtp.flush()
    used = sum(RVC_BYTES if isinstance(item, RvcFrame) else item.discarded for item in frames)
    between = sum(
        item.discarded if isinstance(item, CorruptBytes) else item.size - 2 for item in packets
    )
    if not used == between + shtp.flags == len(data):
        raise UnaccountedError(f"{len(data)} bytes, {used} in RVC, {between} between flags")

    for baud in (115_200, 3_000_000):
        settings = {"id": "S1", "segment": "thigh", "driver": "bno085", "port": "p", "baud": baud}
        decoder = Bno085Imu(Bno085Settings.model_validate(settings)).decoder()
        for number, piece in enumerate(cut(data)):
            decoder.feed(Chunk(BEGIN_NS + number * _MS, piece))
        decoder.flush()


def seeds_bno085() -> list[bytes]:
    """Return frames of both modes."""
    frames = [encode_rvc(RvcFrame(k, (10 * k, -110, 2085), (-371, -20, 977))) for k in range(4)]
    report = HubReport(HubReportId.ROTATION_VECTOR, 1, 3, 1, (0.0, 0.0, 0.6, 0.8, 0.05))
    packets = [encode_shtp(3, k, encode_base_time(12) + encode_report(report)) for k in range(4)]
    packets += [encode_shtp(1, 0, b"\x01"), encode_status(256), encode_status(None)]
    packets.append(encode_shtp(2, 0, encode_firmware((3, 12, 4), 0x7E7D, 230)))
    return [b"".join(frames), b"".join(packets)]


def run_witmotion_bytes(data: bytes) -> None:
    """Decode WitMotion bytes in pieces; every byte belongs to a frame or is counted."""
    codec, found = WitMotionCodec(), []
    for piece in cut(data):
        found += codec.feed(piece)
    found += codec.flush()
    used = sum(
        FRAME_BYTES if isinstance(item, WitMotionFrame) else item.discarded for item in found
    )
    if used != len(data):
        raise UnaccountedError(f"{len(data)} bytes, {used} in frames or discarded")

    for driver in (WitMotionImu(_witmotion()), WitMotionImu(_witmotion(device_time=True))):
        decoder = driver.decoder()
        for number, piece in enumerate(cut(data)):
            decoder.feed(Chunk(BEGIN_NS + number * _MS, piece))
        decoder.flush()


def _witmotion(**more: bool) -> WitMotionSettings:
    return WitMotionSettings.model_validate(
        {"id": "S1", "segment": "thigh", "driver": "witmotion", "port": "p", **more}
    )


def seeds_witmotion() -> list[bytes]:
    """Return frames of all kinds, and of the variant 55 61."""
    frames = [encode_witmotion(kind, bytes(range(8))) for kind in range(0x50, 0x60)]
    return [b"".join(frames), frames[9] * 3, (b"\x55\x61" + bytes(18)) * 4]


def run_slcan(data: bytes) -> None:
    """Decode the bytes of an SLCAN adapter in pieces, then its frames through the core."""
    decoder = SlcanCodec(115_200)
    frames: list[CanFrame] = []
    for number, piece in enumerate(cut(data)):
        found = decoder.feed(piece, BEGIN_NS + number * _MS)
        frames += [item for item in found if isinstance(item, CanFrame)]
    decoder.flush()
    feed_source("S2", [pack_frames([frame]) for frame in frames[:64]])


def seeds_slcan() -> list[bytes]:
    """Return lines of an adapter with and without time stamps."""
    frames = [
        item
        for n in range(4)
        for item in unpack_frames(xcdi_bytes("S2", n, BEGIN_NS))
        if isinstance(item, CanFrame)
    ]
    plain = b"".join(map(encode_slcan, frames))
    return [plain, b"".join(encode_slcan(f, n) for n, f in enumerate(frames)), b"\r\x07z\rF00\r"]


# --- CAN --------------------------------------------------------------------------------------


def run_can_records(data: bytes) -> None:
    """Unpack records; every byte belongs to a frame or is counted."""
    found = unpack_frames(data)
    used = sum(item.discarded if isinstance(item, CorruptBytes) else RECORD_BYTES for item in found)
    if used != len(data):
        raise UnaccountedError(f"{len(data)} bytes, {used} in frames or discarded")
    feed_source("S2", [data])


def _can_frames(data: bytes) -> list[bytes]:
    ids = (*IDS["S2"], *IDS["S4"])
    return [
        pack_frames([CanFrame(BEGIN_NS + n * _MS, ids[kind % len(ids)], payload[:8])])
        for n, (kind, payload) in enumerate(records(data))
    ]


def run_can_source(data: bytes) -> None:
    """Put records into CAN frames of a sensor and take them through decoder and clock."""
    feed_source("S2", _can_frames(data))


def run_can_core(data: bytes) -> None:
    """Put records into CAN frames of a sensor and take them through the core."""
    feed_core("S2", _can_frames(data))


def seeds_can_records() -> list[bytes]:
    """Return groups of an XCDI sensor as records of the recording format."""
    return [b"".join(xcdi_bytes("S2", n, BEGIN_NS) for n in range(count)) for count in (1, 5)]


def seeds_can_core() -> list[bytes]:
    """Return groups of an XCDI sensor: time, counter, quaternion."""
    found = b""
    for n in (0, 1, 2, 3, 500, 501, 65_535, 0):
        for kind, item in enumerate(unpack_frames(xcdi_bytes("S2", n, BEGIN_NS))):
            if isinstance(item, CanFrame):
                found += bytes((kind, len(item.data))) + item.data
    return [found, found[:40]]


# --- VRPN -------------------------------------------------------------------------------------


def run_vrpn(data: bytes) -> None:
    """Decode a VRPN stream in pieces, up to frames; every discarded byte is reported."""
    decoder = VrpnDecoder(VrpnSettings(driver="vrpn", server="x"))
    lost, t_ns = 0, BEGIN_NS
    for piece in cut(data):
        t_ns += _MS
        found = decoder.feed(Chunk(t_ns, piece))
        lost += sum(item.discarded for item in found if isinstance(item, Corrupt))
    lost += sum(item.discarded for item in decoder.flush() if isinstance(item, Corrupt))
    if lost != decoder.discarded_bytes:
        raise UnaccountedError(f"{decoder.discarded_bytes} bytes discarded, {lost} reported")
    vrpn.is_whole(data)
    vrpn.decode_announcement(data)


def seeds_vrpn() -> list[bytes]:
    """Return connections with descriptions, poses and a heartbeat."""
    types = {name: number for number, name in enumerate(vrpn.TYPE_NAMES)}
    opening: list[vrpn.VrpnContent] = [vrpn.Cookie(), vrpn.SenderDescription(1, "Thigh")]
    opening += [vrpn.TypeDescription(number, name) for name, number in types.items()]
    poses: list[vrpn.VrpnContent] = [
        vrpn.TrackerPose(10_000 * n, 1, n % 2, 0.1 * n, 1.0, 2.0, 0.0, 0.0, 0.6, 0.8)
        for n in range(6)
    ]
    rest: list[vrpn.VrpnContent] = [
        vrpn.Ping(0, 1),
        vrpn.UdpChannel(4000, "127.0.0.1"),
        vrpn.Disconnect(),
    ]
    whole = [vrpn.encode(message, types) for message in (*opening, *poses, *rest)]
    return [b"".join(whole), b"".join(whole[:9]), vrpn.encode(vrpn.Cookie()) * 2]


# --- UDP --------------------------------------------------------------------------------------


def run_natnet_codec(data: bytes) -> None:
    """Decode one datagram in every bitstream."""
    for version in VERSIONS:
        found = decode(data, version)
        if isinstance(found, CorruptBytes) and found.discarded != len(data):
            raise UnaccountedError(f"{len(data)} bytes, {found.discarded} discarded")


def run_natnet_source(data: bytes) -> None:
    """Put records of 16-bit length into datagrams and take them through decoder and clock."""
    feed_source("mocap", _datagrams(data))


def run_natnet_core(data: bytes) -> None:
    """Put records of 16-bit length into datagrams and take them through the core."""
    feed_core("mocap", _datagrams(data))


def _datagrams(data: bytes) -> list[bytes]:
    questions = OpenRequests()
    questions.register(Bare(NatNetMessageId.REQUEST_MODELDEF), BEGIN_NS)
    datagrams, at = [], 0
    while at + 3 <= len(data):
        kind, size = struct.unpack_from("<BH", data, at)
        payload = data[at + 3 : at + 3 + size]
        datagrams.append(HEADER.pack(kind, len(payload)) + payload)
        questions.accept(datagrams[-1], BEGIN_NS)
        at += 3 + size
    return datagrams


def _answers() -> list[bytes]:
    frames = [frame(n, markers=(marker(65537, (1.0, 2.0, 3.0)),)) for n in (1, 2, 5)]
    messages: list[Message] = [INFO, MODEL, *frames]
    plain = [encode_natnet(item) for item in messages]
    named = [HEADER.pack(7, len(body := encode_frame(frames[0], (4, 1)))) + body]
    echo = [bytes.fromhex("0d0010004e669a10000000000485e4cd49010000")]
    return plain + named + echo + [HEADER.pack(3, 14) + b"Bitstream,4.1\0"]


def seeds_natnet() -> list[bytes]:
    """Return every kind of datagram that a server sends."""
    return _answers()


def seeds_natnet_core() -> list[bytes]:
    """Return a whole session as records."""
    packed = [struct.pack("<BH", data[0], len(data) - 4) + data[4:] for data in _answers()]
    return [b"".join(packed), *packed]


# --- packets of QTM and Vicon ---------------------------------------------------------------------


def run_qtm_stream(data: bytes) -> None:
    """Split a stream of QTM into packets; every byte belongs to a packet or is counted."""
    stream = qtm.QtmStream()
    found: list[bytes | CorruptBytes] = []
    for piece in cut(data):
        found += stream.feed(piece)
    found += stream.flush()
    used = sum(item.discarded if isinstance(item, CorruptBytes) else len(item) for item in found)
    if used != len(data):
        raise UnaccountedError(f"{len(data)} bytes, {used} in packets or discarded")


def run_qtm_decoder(data: bytes) -> None:
    """Put records of 16-bit length into packets and take them through the decoder of QTM."""
    decoder = QtmDecoder(QtmSettings(driver="qtm", server="x"))
    at = 0
    for packet in seeds_qtm()[:1]:
        decoder.feed(Chunk(BEGIN_NS, packet))
    while at + 3 <= len(data):
        kind, size = struct.unpack_from("<BH", data, at)
        payload = data[at + 3 : at + 3 + size]
        packet = qtm.HEADER.pack(qtm.HEADER.size + len(payload), kind) + payload
        decoder.feed(Chunk(BEGIN_NS + at, packet))
        at += 3 + size


def seeds_qtm() -> list[bytes]:
    """Return settings and frames of QTM."""
    settings = qtm.encode(qtm.SettingsReply(qtm_xml()))
    return [settings, *(qtm.encode(qtm_frame(n)) for n in (1, 2, 5))]


def seeds_qtm_records() -> list[bytes]:
    """Return a session of QTM as records."""
    packed = [struct.pack("<BH", data[4], len(data) - 8) + data[8:] for data in seeds_qtm()]
    return [b"".join(packed), *packed]


def run_vicon_decoder(data: bytes) -> None:
    """Put records of 16-bit length into objects and take each as a packet through the decoder."""
    decoder = ViconDecoder(ViconSettings(driver="vicon", server="x"))
    decoder.feed(Chunk(BEGIN_NS, seeds_vicon()[0]))
    at = 0
    while at + 3 <= len(data):
        kind, size = struct.unpack_from("<BH", data, at)
        item = vicon.OpaqueObject(kind, data[at + 3 : at + 3 + size])
        frame_number = vicon.FrameInfo(at)
        decoder.feed(Chunk(BEGIN_NS + at, vicon.encode(frame_number, item)))
        at += 3 + size
    found = vicon.decode(data)
    if isinstance(found, CorruptBytes) and found.discarded != len(data):
        raise UnaccountedError(f"{len(data)} bytes, {found.discarded} discarded")


def seeds_vicon() -> list[bytes]:
    """Return static objects and frames of Vicon."""
    return [vicon_static(), *(vicon_frame(n) for n in (1, 2, 5))]


def seeds_vicon_records() -> list[bytes]:
    """Return the objects of a session of Vicon as records."""
    packed = []
    for data in seeds_vicon():
        at = vicon.HEADER.size
        while at < len(data):
            kind, size = vicon.HEADER.unpack_from(data, at)
            at += vicon.HEADER.size
            packed.append(struct.pack("<BH", kind & 0xFF, size) + data[at : at + size])
            at += size
    return [b"".join(packed), *packed, seeds_vicon()[1]]


# --- x-IMU3 -----------------------------------------------------------------------------------


def run_ximu3_bytes(data: bytes) -> None:
    """Decode serial bytes in pieces; every byte belongs to a message or is counted."""
    decoder, found = XImu3Codec(), []
    for piece in cut(data):
        found += decoder.feed(piece)
    found += decoder.flush()
    used = sum(item.discarded if isinstance(item, CorruptBytes) else item.size for item in found)
    if used != len(data):
        raise UnaccountedError(f"{len(data)} bytes, {used} in messages or discarded")


def run_ximu3_driver(data: bytes) -> None:
    """Take serial bytes through the driver's decoder, and its events to JSON."""
    table = {"id": "S1", "segment": "thigh", "driver": "ximu3", "port": "p", "sync_wire": 0}
    decoder = XImu3Imu(XImu3Settings.model_validate(table)).decoder()
    for number, piece in enumerate(cut(data)):
        for item in decoder.feed(Chunk(BEGIN_NS + number * PERIOD_NS, piece)):
            if isinstance(item, DeviceEvent):
                encode_payload(item.data)


def seeds_ximu3() -> list[bytes]:
    """Return measurements in every form, reports and replies."""
    q = (0.5, -0.5, 0.1, 0.7)
    data = [encode_ximu3("Q", 1_000_000 + 10_000 * k, q, binary=k % 2 == 0) for k in range(12)]
    other = [
        encode_ximu3("A", 1_130_000, (10.0, 20.0, 30.0)),
        encode_ximu3("Y", 1_130_000, (1.0,)),
        encode_ximu3("B", 1_130_000, (5.0, 3.6, 0.0)),
        encode_ximu3_text("F", 1_130_000, b"fault"),
        encode_ximu3_command("ping", {"interface": "USB", "name": "x-IMU3", "sn": "01234567"}),
        encode_ximu3_command("ahrs_axes_convention", 2),
        encode_ximu3_command("bogus", {"error": "Unknown command"}),
    ]
    return [b"".join(data), b"".join(data[:4] + other), b"".join(other)]


TARGETS = (
    Target("xbus-bytes", run_xbus_bytes, seeds_xbus, share=40),
    Target("xbus-source", run_xbus_source, seeds_xbus_records, share=4),
    Target("xbus-core", run_xbus_core, seeds_xbus_records, share=1),
    Target("ximu3-bytes", run_ximu3_bytes, seeds_ximu3, share=40),
    Target("ximu3-driver", run_ximu3_driver, seeds_ximu3, share=4),
    Target("serial-core", run_serial_core, seeds_xbus, share=1),
    Target("slcan-source", run_slcan, seeds_slcan, share=4),
    Target("bno085-bytes", run_bno085_bytes, seeds_bno085, share=4),
    Target("witmotion-bytes", run_witmotion_bytes, seeds_witmotion, share=4),
    Target("can-records", run_can_records, seeds_can_records, share=3),
    Target("can-source", run_can_source, seeds_can_core, share=4),
    Target("can-core", run_can_core, seeds_can_core, share=1),
    Target("vrpn-source", run_vrpn, seeds_vrpn, share=10, longest=4096),
    Target("natnet-codec", run_natnet_codec, seeds_natnet, share=30, longest=1500),
    Target("natnet-source", run_natnet_source, seeds_natnet_core, share=2, longest=1500),
    Target("natnet-core", run_natnet_core, seeds_natnet_core, share=1, longest=1500),
    Target("qtm-stream", run_qtm_stream, seeds_qtm, share=10, longest=1500),
    Target("qtm-decoder", run_qtm_decoder, seeds_qtm_records, share=4, longest=1500),
    Target("vicon-decoder", run_vicon_decoder, seeds_vicon_records, share=4, longest=1500),
)
