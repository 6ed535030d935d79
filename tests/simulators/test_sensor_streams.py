"""IMU streams count every sample and stamp it with its sampling time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.body._recorded_trial import InterpolatedTrack
from jointfit_simulators.scene._streams import ImuStream
from jointfit_simulators.settings import Knobs, apply_settings, perfect

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
NOW = 5 * 10**12


class StoringDevice:
    """Device that stores its samples; its line can be full."""

    rate_hz = 100.0
    counter = line_ns = 0

    def __init__(self) -> None:
        self.streaming, self.full = True, False
        self.samples: list[tuple[int, tuple[float, ...]]] = []
        self.lost = self._to_lose = 0
        self.plugged = True

    @property
    def sent(self) -> int:
        return len(self.samples)

    def push(self, device_ns: int, q_world_sensor: tuple[float, float, float, float]) -> None:
        if self._to_lose:
            self._to_lose -= 1
            self.lost += 1
        elif not self.full:
            self.samples.append((device_ns, q_world_sensor))

    def lose(self, count: int) -> None:
        self._to_lose += count

    def power_cycle(self) -> None: ...

    def edge(self, device_ns: int) -> None: ...

    def unplug(self) -> None:
        self.plugged = False

    def plug(self) -> None:
        self.plugged = True

    async def run(self) -> None: ...


def stream(knobs: Knobs, device: StoringDevice, *, shared: bool = False) -> ImuStream:
    return ImuStream(knobs, "S1", device, latency_ms=2.0, shared_wire=shared, now_ns=NOW)


def play(source: ImuStream, seconds: int, begin_s: int = 0, *, sending: bool = True) -> int:
    """Send some seconds of upright stance; return the number of samples taken."""
    begin = NOW + begin_s * NS_PER_S
    instants = source.plan(begin, begin + seconds * NS_PER_S)
    assert np.all((instants >= begin) & (instants < begin + seconds * NS_PER_S))
    due = source.fill(instants / NS_PER_S, np.tile(UPRIGHT, (len(instants), 1)))
    for _ in due:
        source.emit(sending=sending)
    return len(due)


@pytest.mark.parametrize("skew", [0, 50])
def test_every_sample_is_sent_dropped_or_refused(skew: int) -> None:
    device = StoringDevice()
    source = stream(
        apply_settings(perfect(Knobs()), ["dropout=0.1", f"clock_skew_ppm={skew}"]), device
    )
    taken = play(source, 20)
    device.full = True
    taken += play(source, 5, 20)
    assert taken == pytest.approx(2500, abs=1)
    assert source.dropped_out == device.lost == pytest.approx(250, rel=0.25)
    assert source.refused == pytest.approx(450, rel=0.1)
    assert device.sent + source.dropped_out + source.refused == taken
    assert source.unheard == 0


def test_samples_without_a_receiver_are_counted_separately() -> None:
    device = StoringDevice()
    source = stream(perfect(Knobs()), device, shared=True)
    source.unplug()
    unheard = play(source, 1)
    assert device.plugged  # other devices share the wire
    source.plug()
    unheard += play(source, 1, 1, sending=False)
    device.streaming = False
    unheard += play(source, 1, 2)
    assert (device.sent, source.unheard) == (0, unheard)


def test_unplugging_disconnects_an_unshared_wire() -> None:
    device = StoringDevice()
    source = stream(perfect(Knobs()), device)
    source.unplug()
    assert not device.plugged
    source.plug()
    assert device.plugged


def test_stamps_are_device_times_of_the_true_instants() -> None:
    device = StoringDevice()
    source = stream(
        apply_settings(perfect(Knobs()), ["clock_skew_ppm=50", "latency_jitter_ms=5"]), device
    )
    instants = source.plan(NOW, NOW + 10 * NS_PER_S)
    for _ in source.fill(instants / NS_PER_S, np.tile(UPRIGHT, (len(instants), 1))):
        source.emit()
    clock = source.timing.clock
    shown = [clock.device_ns(int(t)) for t in instants]
    assert np.abs(np.subtract([stamp for stamp, _ in device.samples], shown)).max() <= 2
    assert clock.skew != 0


def test_interpolation_does_not_depend_on_quaternion_signs() -> None:
    t = np.linspace(0.0, 1.0, 40)
    turns = Rotation.from_rotvec(np.outer(t, [0.3, 2.0, -0.5]))
    quaternions = turns.as_quat(scalar_first=True)
    flipped = quaternions * np.where(np.arange(40) % 3, 1.0, -1.0)[:, None]
    between = np.linspace(0.01, 0.99, 100)
    one, other = (
        InterpolatedTrack(t, q, rotation=True).at(between) for q in (quaternions, flipped)
    )
    np.testing.assert_allclose(np.abs(np.sum(one * other, axis=1)), 1.0, atol=1e-12)
