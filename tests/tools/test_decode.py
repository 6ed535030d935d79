"""`jointfit decode` finds in real captures exactly the counts that their documents state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.tools.__main__ import app
from jointfit_protocols.xbus import XbusCodec, XbusMessage, encode
from jointfit_protocols.xcdi import XcdiIds
from jointfit_protocols.ximu3 import encode_data
from jointfit_simulators.devices import XcdiDevice, XcdiDeviceOptions

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_protocols.can import CanFrame

run = CliRunner().invoke
FIRST = [0.0038471566513180733, -0.003237534314393997, -0.764083743095398, 0.6450973749160767]
LAST = [0.005248169880360365, -0.00006282110553001985, -0.7643200755119324, 0.6448156237602234]


def summary(protocol: str, file: Path, *more: str) -> dict[str, Any]:
    result = run(app, ["decode", protocol, str(file), "--summary", *more])
    assert result.exit_code == 0, result.stderr
    found: dict[str, Any] = orjson.loads(result.stdout)
    return found


def xsens(shared_data: Path, number: int) -> Path:
    return shared_data / "imu" / "xsens" / f"{number}.output.bin"


# --- Xsens ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("number", "quaternions"), [(1, 0), (3, 0), (5, 92)])
def test_the_xsens_captures_hold_a_hundred_messages_each(
    shared_data: Path, number: int, quaternions: int
) -> None:
    found = summary("xbus", xsens(shared_data, number))
    assert found == {
        "messages": 100,
        "rejected": 0,
        "corrupt": 0,
        "discarded_bytes": 0,
        "quaternions": quaternions,
        "first_quaternion": FIRST if quaternions else None,
        "last_quaternion": LAST if quaternions else None,
        # The device time decreases four times, but only in messages without orientation, which the
        # driver ignores.
        "time_resets": 0,
        "counter_gaps": 0,
    }


def frame_at(wire: bytes, number: int) -> int:
    """Return the byte position at which message `number` (from 0) begins."""
    frames = [event for event in XbusCodec().feed(wire) if isinstance(event, XbusMessage)]
    return sum(len(encode(m.mid, m.data, m.bid)) for m in frames[:number])


def flipped(wire: bytes) -> bytes:
    return wire[:93] + bytes([wire[93] ^ 1]) + wire[94:]


def inserted(what: bytes) -> Callable[[bytes], bytes]:
    """Return a function that inserts bytes before message number 50 (from 0)."""

    def cut(wire: bytes) -> bytes:
        at = frame_at(wire, 50)
        return wire[:at] + what + wire[at:]

    return cut


def long_tenth(wire: bytes) -> bytes:
    at = frame_at(wire, 10) + 3
    return wire[:at] + b"\xfe" + wire[at + 1 :]


def begun_inside(number: int, from_end: int) -> Callable[[bytes], bytes]:
    """Return a function that omits the start of a capture.

    The remaining capture begins `from_end` bytes before the end of message `number` (from 0).
    """
    return lambda wire: wire[frame_at(wire, number + 1) - from_end :]


@pytest.mark.parametrize(
    ("number", "damage", "counts"),
    [
        pytest.param(5, lambda wire: wire[10:], (99, 43), id="first 10 bytes removed"),
        pytest.param(5, lambda wire: wire[:-20], (99, 143), id="last 20 bytes removed"),
        pytest.param(5, flipped, (99, 75), id="one bit flipped in frame 1"),
        pytest.param(5, inserted(b"\xfa"), (100, 1), id="FA inserted"),
        pytest.param(
            5, inserted(bytes.fromhex("faff36ff07d0")), (100, 6), id="false 2000-byte header"
        ),
        pytest.param(5, long_tenth, (99, 141), id="LEN of frame 10 set to FE"),
        pytest.param(1, begun_inside(36, 137), (63, 137), id="begun inside frame 36"),
        pytest.param(1, begun_inside(48, 45), (51, 45), id="begun inside frame 48"),
    ],
)
def test_damaged_captures_lose_damaged_bytes_only(
    tmp_path: Path,
    shared_data: Path,
    number: int,
    damage: Callable[[bytes], bytes],
    counts: tuple[int, int],
) -> None:
    file = tmp_path / "damaged.bin"
    file.write_bytes(damage(xsens(shared_data, number).read_bytes()))
    found = summary("xbus", file)
    assert (found["messages"], found["discarded_bytes"]) == counts
    assert found["corrupt"] > 0


def test_as_lines_every_item_is_one_json_object(shared_data: Path) -> None:
    result = run(app, ["decode", "xbus", str(xsens(shared_data, 5)), "--jsonl"])
    rows = [orjson.loads(line) for line in result.stdout.splitlines()]
    assert [row["type"] for row in rows] == ["imu"] * 92
    assert (rows[0]["q_native"], rows[-1]["q_native"]) == (FIRST, LAST)
    assert (rows[0]["counter"], rows[0]["ticks"]) == (43800, 51747818)


# --- MicroStrain, x-IMU3 ------------------------------------------------------------------------


def test_the_mip_capture_holds_8384_packets_and_no_orientation(shared_data: Path) -> None:
    found = summary("mip", shared_data / "imu" / "microstrain" / "mip_data.bin")
    assert (found["messages"], found["quaternions"]) == (8384, 0)
    assert found["rejected"] == found["corrupt"] == found["discarded_bytes"] == 0
    assert found["time_resets"] == found["counter_gaps"] == 0


@pytest.mark.parametrize(
    ("damage", "counts"),
    [
        pytest.param(lambda wire: wire[5:], (8383, 5), id="first 5 bytes removed"),
        pytest.param(lambda wire: wire[145_690:], (5158, 18), id="begun at the pair in a packet"),
        pytest.param(lambda wire: wire[:-7], (8383, 47), id="last 7 bytes removed"),
    ],
)
def test_a_damaged_mip_capture_loses_damaged_bytes_only(
    tmp_path: Path,
    shared_data: Path,
    damage: Callable[[bytes], bytes],
    counts: tuple[int, int],
) -> None:
    file = tmp_path / "damaged.bin"
    file.write_bytes(damage((shared_data / "imu" / "microstrain" / "mip_data.bin").read_bytes()))
    found = summary("mip", file)
    assert (found["messages"], found["discarded_bytes"]) == counts


def test_the_ximu3_file_holds_203_messages_of_which_one_has_no_unit_norm(shared_data: Path) -> None:
    file = shared_data / "imu" / "ximu3" / "synthetic_quaternion.ximu3"
    found = summary("ximu3", file)
    assert (found["messages"], found["rejected"], found["quaternions"]) == (203, 1, 202)
    assert found["corrupt"] == found["discarded_bytes"] == found["time_resets"] == 0
    printed = run(app, ["decode", "ximu3", str(file)]).stderr
    assert "1 rejected: quaternion norm is not 1" in printed


def test_a_capture_whose_messages_are_all_rejected_states_the_reason(tmp_path: Path) -> None:
    file = tmp_path / "half.bin"
    file.write_bytes(b"".join(encode_data("Q", 2500 * n, (0.5, 0.0, 0.0, 0.0)) for n in range(20)))
    result = run(app, ["decode", "ximu3", str(file)])
    assert result.exit_code == 0
    assert "20 rejected: quaternion norm is not 1" in result.stderr


# --- NatNet -----------------------------------------------------------------------------------


def test_the_natnet_capture_holds_550_messages(shared_data: Path) -> None:
    traffic = shared_data / "mocap/natnet_v3_mje-nz/test_data/raw/traffic.pcapng"
    found = summary("natnet", traffic)
    assert found["messages"] == 550
    assert found["corrupt"] == found["discarded_bytes"] == 0
    assert found["time_resets"] == found["counter_gaps"] == 0
    # Five frames precede the model with the names of their content.
    assert found["mocap_frames"] == found["quaternions"] == 513


# --- XCDI -------------------------------------------------------------------------------------


class CaptureTape:
    """CAN wire that stores the sent frames."""

    is_open = True

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []

    def send(self, frames: list[CanFrame]) -> bool:
        self.frames += frames
        return True


def test_a_candump_log_of_one_sensor_among_others_is_decoded(tmp_path: Path) -> None:
    tape = CaptureTape()
    ids = XcdiIds(0x105, 0x106, 0x121, status_word=None, error=None)
    device = XcdiDevice(tape, XcdiDeviceOptions(ids=ids))  # type: ignore[arg-type]
    for number in range(50):
        if number == 20:
            device.lose(2)
        device.push(number * 10_000_000, (0.5, 0.5, 0.5, 0.5) if number else (1.0, 0.0, 0.0, 0.0))
    lines = [
        f"({1e9 + i / 300:.6f}) can0 {frame.can_id:03X}#{frame.data.hex().upper()}"
        for i, frame in enumerate(tape.frames)
    ]
    file = tmp_path / "can.log"
    file.write_text("\n".join(["(1000000000.0) can0 7FF#00", *lines, "no frame", ""]))
    keys = "{ sample_time = 0x105, group_counter = 0x106, quaternion = 0x121 }"
    found = summary("xcdi", file, "--set", f"ids={keys}")
    assert found["quaternions"] == 48
    assert found["messages"] == 3 * 48
    assert found["first_quaternion"] == pytest.approx([1, 0, 0, 0], abs=1e-4)
    assert found["last_quaternion"] == pytest.approx([0.5] * 4, abs=1e-4)
    assert found["counter_gaps"] == 1
    assert found["time_resets"] == 0
    assert (found["corrupt"], found["discarded_bytes"]) == (1, len("no frame\n"))


# --- mistakes ---------------------------------------------------------------------------------


def test_unknown_driver_is_reported_with_a_suggestion(shared_data: Path) -> None:
    result = run(app, ["decode", "xbuss", str(xsens(shared_data, 5)), "--summary"])
    assert result.exit_code == 2
    assert "did you mean 'xbus'?" in result.stderr
    assert result.stdout == ""


def test_settings_that_contradict_each_other_are_named(tmp_path: Path) -> None:
    (tmp_path / "raw").write_bytes(bytes(40))
    result = run(app, ["decode", "bno085", str(tmp_path / "raw"), "--set", "baud=9600"])
    assert result.exit_code == 2
    assert "bno085.baud: 9600 is no speed of a BNO085" in result.stderr


def test_missing_capture_file_is_reported_by_name(tmp_path: Path) -> None:
    result = run(app, ["decode", "xbus", str(tmp_path / "gone.bin"), "--summary"])
    assert result.exit_code == 2
    assert "gone.bin" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_capture_of_another_wire_is_refused(shared_data: Path) -> None:
    traffic = shared_data / "mocap/natnet_v3_mje-nz/test_data/raw/traffic.pcapng"
    result = run(app, ["decode", "xbus", str(traffic)])
    assert result.exit_code == 2
    assert "network capture" in result.stderr


# --- nothing found ----------------------------------------------------------------------------


def refusal(*arguments: str) -> str:
    result = run(app, ["decode", *arguments])
    assert result.exit_code == 2
    return result.stderr


def test_an_empty_capture_and_a_capture_of_another_device_are_named(
    shared_data: Path, tmp_path: Path
) -> None:
    empty = tmp_path / "empty.bin"
    empty.touch()
    assert "the file is empty" in refusal("mip", str(empty))
    assert "jointfit decode xbus" in refusal("mip", str(xsens(shared_data, 5)))


def test_a_message_by_chance_does_not_hide_the_device_of_a_capture(tmp_path: Path) -> None:
    file = tmp_path / "other.bin"
    device_message = bytes.fromhex("FA FF 31 00 D0")  # GotoConfigAck, a message without content
    file.write_bytes(device_message + 400 * b"\x55\x51\x00\x01")
    result = run(app, ["decode", "xbus", str(file)])
    assert "messages" in result.stdout
    assert "no usable message of xbus in 1605 bytes: select the driver" in result.stderr


def test_frames_of_a_can_capture_lead_to_the_identifiers_and_the_command(tmp_path: Path) -> None:
    log = tmp_path / "can.log"
    lines = [f"({k / 100:.6f}) can0 131#0000000000004000" for k in range(50)]
    log.write_text("\n".join(lines))
    assert "1 identifiers (0x131)" in refusal("xcdi", str(log))
    assert refusal("xbus", str(log)).rstrip().endswith("can-table, lpms-can, xcdi")
    missing = refusal("lpms-can", str(log))
    assert "lpms-can.mode: missing; `canopen`" in missing
    assert "--set KEY=VALUE" in missing
