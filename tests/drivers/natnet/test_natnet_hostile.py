"""Invalid input of a NatNet server is counted and not used, and the memory is bounded."""

from __future__ import annotations

import select
import socket
import time

import numpy as np
import pytest

from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_daemon.model import Chunk, ClockEcho, Corrupt, MocapFrame
from jointfit_drivers.natnet import NatNetSettings
from jointfit_drivers.natnet._open_requests import ANSWER_NS, ECHO_NS, OpenRequests
from jointfit_drivers.natnet._server_checks import (
    LEAST_CLOCK_HZ,
    MOST_CLOCK_HZ,
    check_group,
    check_server,
)
from jointfit_drivers.ports.udp_socket import UdpSocket
from jointfit_protocols.natnet import (
    Bare,
    BodyDescription,
    CommandRequest,
    CommandResponse,
    Connect,
    EchoRequest,
    EchoResponse,
    MarkerSetDescription,
    Message,
    ModelDefinition,
    NatNetMessageId,
    SkeletonDescription,
    encode,
)
from tests.drivers.natnet.feeder import INFO, MODEL, Feeder, frame, marker, ready, told

S = 10**9
SETTINGS = NatNetSettings(driver="natnet", server="x")


# --- numbers ----------------------------------------------------------------------------------


@pytest.mark.parametrize("hz", [1, LEAST_CLOCK_HZ - 1, MOST_CLOCK_HZ + 1, 2**53, 2**64 - 1])
def test_a_clock_frequency_that_no_counter_has_is_not_used(hz: int) -> None:
    feeder = Feeder()
    (info,) = told(feeder(INFO._replace(clock_hz=hz)), "info")
    assert info.data["clock_hz"] is None
    assert feeder.decoder.tick_clock is None
    with pytest.raises(
        DeviceMisconfiguredError, match=f"clock frequency of {hz} Hz, expected 1000 to"
    ):
        check_server("NatNet server x:1510", SETTINGS, INFO._replace(clock_hz=hz))


def test_a_multicast_server_without_a_data_port_is_refused() -> None:
    with pytest.raises(DeviceMisconfiguredError, match=r"data port 0: set mocap\.data_port"):
        check_group("NatNet server x:1510", INFO, 0)


def test_stamps_beyond_64_bits_of_nanoseconds_are_no_time() -> None:
    feeder = ready()
    late = feeder.frame(frame(1, exposure=2**64 - 1, ticks=5))
    assert late.ticks is None
    assert feeder(EchoResponse(1_000, 2**64 - 1), t_ns=2_000) == []
    assert feeder.decoder.suspicious == 2
    assert isinstance(feeder(EchoResponse(1_000, 77), t_ns=2_000)[0], ClockEcho)


def test_the_latency_of_usb_cameras_does_not_lead_before_the_start_of_the_counter() -> None:
    """A device time before the start of the server counter would be negative."""
    assert ready(latency_ms=10.0).frame(frame(1, exposure=0, ticks=5)).ticks == 0


@pytest.mark.parametrize("far", [1e38, -20_000.0, float("inf"), float("nan")])
def test_an_impossible_position_counts_as_an_occluded_marker(far: float) -> None:
    """A position is impossible if it is not finite or too far from the origin."""
    got = ready().frame(frame(1, markers=(marker(65537, (0.0, far, 0.0)),)))
    assert np.isnan(got.markers).all()


def test_a_frame_number_that_was_not_counted_up_to_is_a_restart_and_no_loss() -> None:
    """The number increases by more than the elapsed time permits."""
    feeder = ready()
    feeder(frame(1))
    out = feeder(frame(2**31 - 1, ticks=10**6), t_ns=S)
    assert len(told(out, "restart")) == 1
    assert told(out, "gap") == []


def test_frames_lost_in_a_long_silence_are_counted() -> None:
    feeder = ready()
    feeder(frame(1))
    (gap,) = told(feeder(frame(20_001, ticks=10**9), t_ns=10 * S), "gap")
    assert gap.data["lost"] == 19_999


# --- announcements ----------------------------------------------------------------------------


@pytest.mark.parametrize("text", [b"Bitstream,2.9", b"Bitstream,4.1", b"Bitstream,99.99"])
def test_a_bitstream_that_frames_do_not_have_is_not_adopted(text: bytes) -> None:
    feeder = ready()
    assert feeder(CommandResponse(text + b"\0")) == []
    (found,) = feeder(frame(1))
    assert isinstance(found, MocapFrame)


def test_a_server_that_names_another_bitstream_than_it_sends_stays_readable() -> None:
    feeder = ready()
    feeder(INFO._replace(natnet_version=(4, 1, 0, 0)))
    assert any(isinstance(event, MocapFrame) for event in feeder(frame(1)))


def giant(count: int) -> ModelDefinition:
    return ModelDefinition((MarkerSetDescription("set", ("",) * count),))


@pytest.mark.parametrize(
    "model",
    [
        giant(60_000),
        ModelDefinition((MarkerSetDescription("set", tuple(f"{i:x}" for i in range(12_000))),)),
        ModelDefinition(
            (SkeletonDescription("s", 1, (BodyDescription("b", 1),) * 1_500),),
        ),
        ModelDefinition((BodyDescription("b", 1),) * 1_600),
    ],
    ids=["same-names", "own-names", "same-bones", "same-bodies"],
)
def test_a_model_of_one_datagram_costs_no_second_and_bounded_columns(
    model: ModelDefinition,
) -> None:
    """A model with very many items takes less than 1 s and has at most 4000 markers and bodies."""
    feeder = Feeder(markers={"thigh": ["T1", "T2", "T3", "T4"]})
    feeder(INFO)
    began = time.process_time()
    out = feeder(model)
    assert time.process_time() - began < 1.0
    got = feeder.frame(frame(1))
    assert len(got.layout.markers) + len(got.layout.bodies) <= 4_000
    assert all(len(str(event)) < 100_000 for event in out)


# --- answers ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        (Connect(), INFO),
        (Bare(NatNetMessageId.REQUEST_MODELDEF), MODEL),
        (CommandRequest("Bitstream,4.1"), CommandResponse(b"Bitstream,4.1\0")),
        (EchoRequest(S), EchoResponse(S, 5)),
    ],
    ids=["info", "model", "response", "echo"],
)
def test_an_answer_is_accepted_once_in_time_and_only_when_asked_for(
    question: Message, answer: Message
) -> None:
    """An answer must follow its request within a time limit."""
    questions, data = OpenRequests(), encode(answer)
    assert not questions.accept(data, S)
    questions.register(question, S)
    assert questions.accept(data, S + 1)
    assert not questions.accept(data, S + 2)
    questions.register(question, S)
    assert not questions.accept(data, S + 1 + max(ANSWER_NS, ECHO_NS))
    assert questions.unsolicited == 3


def test_an_echo_with_a_forged_stamp_is_dropped() -> None:
    questions = OpenRequests()
    questions.register(EchoRequest(S), S)
    assert not questions.accept(encode(EchoResponse(S + 1, 5)), S + 2)
    assert questions.accept(encode(EchoResponse(S, 5)), S + 2)


def test_corrupt_control_datagrams_reach_the_decoder_and_are_counted_there() -> None:
    for data in (b"", b"\x0d", encode(INFO)[:50], b"\x0d\x00\x02\x00\x00\x00"):
        feeder = ready()
        lost = sum(
            e.discarded for e in feeder.decoder.feed(Chunk(0, data)) if isinstance(e, Corrupt)
        )
        assert lost == len(data)


# --- sockets ----------------------------------------------------------------------------------


@pytest.fixture
def listening() -> UdpSocket:
    return UdpSocket("127.0.0.1", 0, sender="127.0.0.1")


def wait_readable(opened: UdpSocket, seconds: float) -> bool:
    poll = select.poll()
    poll.register(opened.fileno(), select.POLLIN | select.POLLERR)
    return bool(poll.poll(round(1000 * seconds)))


def _from(address: str, target: int, *data: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((address, 0))
        for item in data:
            sender.sendto(item, ("127.0.0.1", target))


def test_a_flood_from_another_address_does_not_push_out_the_servers_datagrams(
    listening: UdpSocket,
) -> None:
    try:
        _from("127.0.0.2", listening.port, *[bytes(1400)] * 5_000)
        _from("127.0.0.1", listening.port, b"frame")
        assert b"frame" in [arrival.data for arrival in listening.receive()]
    finally:
        listening.close()


def test_a_refusal_is_reported_once_and_does_not_keep_the_socket_readable(
    listening: UdpSocket,
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        nobody = gone.getsockname()
    try:
        listening.send(b"x", nobody)
        assert wait_readable(listening, 1.0)
        with pytest.raises(ConnectionRefusedError):
            listening.receive()
        assert not wait_readable(listening, 0.05)
    finally:
        listening.close()
