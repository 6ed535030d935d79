"""CAN buses that cannot be opened: servers that are off or silent, and libraries that hang."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import threading
import time
from typing import TYPE_CHECKING, Any

import can
import pytest

from jointfit_daemon.driver import CanBusSettings, DeviceLostError
from jointfit_drivers.ports import _bus_opening
from jointfit_drivers.ports.can_bus import shared_bus
from jointfit_protocols.can import CanFrame, unpack_frames

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.model import Chunk


def socketcand(port: int) -> CanBusSettings:
    more: dict[str, Any] = {"host": "127.0.0.1", "port": port}
    return CanBusSettings(interface="socketcand", channel="can0", **more)


@contextlib.contextmanager
def listening() -> Iterator[tuple[socket.socket, int]]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server, server.getsockname()[1]


async def fault_of(bus: CanBusSettings) -> str:
    with pytest.raises(DeviceLostError) as lost:
        async with shared_bus(bus):
            pass
    return str(lost.value)


async def test_a_server_that_is_off_is_reported_at_once_and_costs_no_processor_time() -> None:
    with listening() as (_, port):
        pass
    began, used = time.monotonic(), time.process_time()
    for _ in range(10):
        assert await fault_of(socketcand(port)) == (
            f"can0: socketcand server 127.0.0.1:{port}: Connection refused: start socketcand "
            "there, or correct host and port in its [can] table"
        )
    assert time.process_time() - used < 0.5
    assert time.monotonic() - began < 5.0


async def test_a_server_that_never_answers_is_reported_and_blocks_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_bus_opening, "_SERVER_S", 0.3)
    with listening() as (_, port):
        opening = asyncio.create_task(fault_of(socketcand(port)))
        late_s, at = 0.0, time.monotonic()
        while not opening.done():
            await asyncio.sleep(0.01)
            now = time.monotonic()
            late_s, at = max(late_s, now - at), now
        assert "no answer within 0.3 s: start socketcand there" in opening.result()
        assert late_s < 0.25, "the event loop was blocked"


async def test_a_cancelled_opening_ends_at_once() -> None:
    with listening() as (_, port):
        opening = asyncio.create_task(fault_of(socketcand(port)))
        await asyncio.sleep(0.05)
        began = time.monotonic()
        opening.cancel()
        await asyncio.wait({opening})
        assert time.monotonic() - began < 0.5


@pytest.mark.parametrize(
    ("answers", "words"),
    [
        ([b"SSH-2.0-OpenSSH_9.2"], "found 'SSH-2.0-OpenSSH_9.2', expected the greeting '< hi >'"),
        ([], "found '', expected the greeting"),
        (
            [b"< hi >", b"< error could not open bus >"],
            "found '< error could not open bus >' after opening can0, expected '< ok >': start the "
            "server for this bus (`socketcand -i can0`), or correct `channel`",
        ),
    ],
)
async def test_another_server_or_another_bus_is_reported_with_what_was_found(
    answers: list[bytes], words: str
) -> None:
    with listening() as (server, port), answering(server, answers):
        fault = await fault_of(socketcand(port))
    assert words in fault


async def test_a_server_that_works_is_read() -> None:
    chunks: list[Chunk] = []
    frames = b"< frame 021 1.0 0102030405060708 >"
    with listening() as (server, port), answering(server, [b"< hi >", *2 * [b"< ok >"]], frames):
        async with shared_bus(socketcand(port)) as bus:
            key = (0x21, False)
            pump = bus.pump("S3", {key: "quaternion"}, chunks.append, 5.0, needed=key)
            reading = asyncio.create_task(pump)
            async with asyncio.timeout(5.0):
                while not chunks:
                    await asyncio.sleep(0.01)
            reading.cancel()
            await asyncio.wait({reading})
    (frame,) = unpack_frames(chunks[0].data)
    assert isinstance(frame, CanFrame)
    assert (frame.can_id, frame.data) == (0x21, bytes(range(1, 9)))


async def test_a_server_that_ends_is_reported_at_once_and_costs_no_processor_time() -> None:
    with listening() as (server, port), answering(server, [b"< hi >", *2 * [b"< ok >"]]):
        used = time.process_time()
        async with shared_bus(socketcand(port)) as bus, asyncio.timeout(3.0):
            key = (0x21, False)
            with pytest.raises(DeviceLostError, match="the server closed the connection: start it"):
                await bus.pump("S3", {key: "quaternion"}, lambda _: None, 5.0, needed=key)
    assert time.process_time() - used < 0.5


async def test_a_connection_that_is_reset_is_reported_without_a_traceback() -> None:
    with listening() as (server, port):

        def serve() -> None:
            for _ in range(2):  # first the check of the server, then the bus
                connection, _ = server.accept()
                connection.sendall(b"< hi >")
                for _ in range(2):
                    connection.recv(256)
                    connection.sendall(b"< ok >")
                linger = struct.pack("ii", 1, 0)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
                connection.close()

        thread = threading.Thread(target=serve)
        thread.start()
        async with shared_bus(socketcand(port)) as bus, asyncio.timeout(3.0):
            key = (0x21, False)
            with pytest.raises(DeviceLostError) as lost:
                await bus.pump("S3", {key: "quaternion"}, lambda _: None, 5.0, needed=key)
        thread.join()
    assert str(lost.value) == (
        "can0 (socketcand): Connection reset by peer: check the server and the network, or correct "
        "`channel`"
    )


async def test_a_library_that_hangs_is_called_by_one_thread_only_and_its_late_bus_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    released, calls, closed = threading.Event(), [], threading.Event()

    class Late:
        def shutdown(self) -> None:
            closed.set()

    def hang(**_: object) -> Late:
        calls.append(threading.current_thread())
        released.wait(10.0)
        return Late()

    monkeypatch.setattr(can, "Bus", hang)
    monkeypatch.setattr(_bus_opening, "OPEN_S", 0.1)
    bus = CanBusSettings(interface="robotell", channel="/dev/ttyUSB9")
    faults = {await fault_of(bus) for _ in range(3)}
    assert faults == {
        "/dev/ttyUSB9 (robotell): not opened within 0.1 s: restart its adapter or server, and "
        "check its [can] table; retrying as soon as the library of the bus returns"
    }
    assert len(calls) == 1
    assert calls[0].daemon, "the exit of the process would wait for this thread"
    released.set()
    assert closed.wait(5.0)
    calls[0].join()
    assert not _bus_opening._opening


@contextlib.contextmanager
def answering(server: socket.socket, answers: list[bytes], frames: bytes = b"") -> Iterator[None]:
    """Send each client the first answer, one answer for each of its texts, and then `frames`."""

    def serve() -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                for number, answer in enumerate(answers):
                    if number and not connection.recv(256):
                        break
                    connection.sendall(answer)
                else:
                    if frames:
                        connection.sendall(frames)
                        connection.recv(256)  # until the client disconnects

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        server.shutdown(socket.SHUT_RDWR)
        thread.join()
