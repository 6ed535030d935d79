"""Plausibility check of lengths in model files.

If a file contains millimetres, but declares metres or no unit, the chain would be a thousand times
too large. No point of a human body segment is ten metres from the segment's origin, so files with
such points are rejected.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.text import MalformedFileError

if TYPE_CHECKING:
    from jointfit_daemon.kinematics.chains import ChainModel

FARTHEST_M = 10.0
"""Largest distance of a point from the origin of its segment, m."""


def require_metres(source: str, model: ChainModel) -> ChainModel:
    """Return the model if its lengths are plausible in metres.

    Raises
    ------
    MalformedFileError
        A marker or a joint center is more than 10 m from its segment's origin.
    """
    points = {f"marker {m.name!r}": m.position for m in model.markers}
    for s in model.segments:
        points[f"center of {s.name!r}"] = s.joint.center
        points[f"center of {s.name!r} in its parent"] = s.joint.center_in_parent
        for sample in s.joint.path:
            points[f"path of {s.name!r} at {sample[0]:g}"] = sample[5:]

    far = {what: float(np.abs(at).max()) for what, at in points.items()}
    what = max(far, key=lambda name: far[name])
    if far[what] > FARTHEST_M:
        raise MalformedFileError(
            f"{source}: {what} is {far[what]:.3g} m away from its segment; lengths must be metres:"
            " is the file in millimetres?"
        )
    return model
