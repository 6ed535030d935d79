"""Compact storage of training frames, with which online learning retains earlier movements.

The number of frames is limited. They are spread evenly over postures, and are the newest frames of
each posture. Postures are distinguished by the direction of gravity in the first segment and by the
joint rotations. Each of these components is divided into cells of 0.25 rad.

The encoding is text. Rounding of a quaternion component to 1/32767 causes an error of about 0.003°.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.soft_tissue._limb_fit import LimbTraining, mean_of
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import inner_joints

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.model import Chain


MOST = 800
"""Largest number of frames. The models have a few hundred parameters. A frame of four sensors and
two segments has 50 bytes.
"""
CELL = 0.25
"""Width of a posture cell, rad."""
MOVEMENTS = 3
"""Largest number of distinct movement labels; older movements are merged."""
_ONE = 32767
"""Integer that represents 1."""


def pack(chain: Chain, training: LimbTraining) -> str:
    """Return frames in order of time, with their movement labels, as text."""
    columns = [training.sensors[s] for group in chain.sensors for s in group]
    columns += [training.reference[name] for name in chain.segments]
    counts = np.round(np.concatenate(columns, axis=1) * _ONE)
    labels = _labels(training)[:, None].astype(np.float64)
    table = np.concatenate([counts, labels], axis=1).astype("<i2")
    return b64encode(table.tobytes()).decode("ascii")


def unpack(chain: Chain, text: str) -> LimbTraining | None:
    """Return the frames from a text; None if the text is empty or belongs to another chain."""
    sensors = [s for group in chain.sensors for s in group]
    width = 4 * (len(sensors) + len(chain.segments)) + 1
    table = np.frombuffer(b64decode(text), dtype="<i2")
    if table.size == 0 or table.size % width:
        return None

    rows = table.reshape(-1, width).astype(np.float64)
    columns = [rotation.normalize(rows[:, i : i + 4]) for i in range(0, width - 1, 4)]
    count = len(sensors)
    return LimbTraining(
        dict(zip(sensors, columns[:count], strict=True)),
        dict(zip(chain.segments, columns[count:], strict=True)),
        rows[:, -1].astype(np.int64),
    )


def join_training(old: LimbTraining, new: LimbTraining) -> LimbTraining:
    """Return the frames of `old`, then those of `new`. The new frames get a new movement label."""
    before = _labels(old)
    labels = np.concatenate([before, np.full(len(new), before.max(initial=-1) + 1)])
    labels = np.maximum(labels - max(int(labels.max()) - MOVEMENTS + 1, 0), 0)
    return LimbTraining(
        {name: np.concatenate([q, new.sensors[name]]) for name, q in old.sensors.items()},
        {name: np.concatenate([q, new.reference[name]]) for name, q in old.reference.items()},
        labels,
    )


def thin_evenly(chain: Chain, training: LimbTraining, most: int = MOST) -> LimbTraining:
    """Return at most `most` frames, distributed evenly over postures.

    The newest frame of every posture is selected first, then the second newest, and so on. Rare
    postures are thus retained, and the frames of frequent postures are replaced.
    """
    if len(training) <= most:
        return training
    cells = postures(chain, training)
    _, which = np.unique(cells, axis=0, return_inverse=True)
    which = np.ravel(which)

    # Compute the rank of every frame within its posture, newest first.
    newest = np.arange(len(which))[::-1]
    by_cell = newest[np.argsort(which[newest], kind="stable")]
    edges = np.flatnonzero(np.diff(which[by_cell], prepend=-1))
    starts = np.repeat(edges, np.diff(np.append(edges, len(by_cell))))
    turn = np.empty(len(which), dtype=np.int64)
    turn[by_cell] = np.arange(len(by_cell)) - starts

    order = np.lexsort((-np.arange(len(which)), turn))
    return training.rows(np.sort(order[:most]))


def postures(chain: Chain, training: LimbTraining) -> NDArray[np.int64]:
    """Return the posture cell of every frame, from direction of gravity and joint rotations."""
    means = [mean_of(training, group) for group in chain.sensors]
    seen = [rotation.rotate(rotation.conjugate(means[0]), np.array([0.0, 0.0, 1.0]))]
    seen += [
        rotation.log(rotation.multiply(rotation.conjugate(above), below))
        for above, below in ((means[j.proximal], means[j.distal]) for j in inner_joints(chain))
    ]
    return np.round(np.concatenate(seen, axis=1) / CELL).astype(np.int64)


def _labels(training: LimbTraining) -> NDArray[np.int64]:
    if training.trials is None:
        return np.zeros(len(training), dtype=np.int64)
    return training.trials
