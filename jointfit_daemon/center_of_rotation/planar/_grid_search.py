"""Grid search for the center with the smallest variance of distances.

This method of Akbarifar et al. (2021) is the baseline to which the other planar methods are
compared. Its accuracy is limited by the extent of the grid on short arcs, and by the step of the
grid on long arcs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array


_AT_ONCE = 400_000
"""Number of distances computed at a time, so that they fit in the processor cache."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Square grid of nodes with a node at its center."""

    middle: tuple[float, float] = (0.0, 0.0)
    """Middle of the grid, m."""
    half_width: float = 0.05
    """Distance from the middle to the edge, m."""
    step: float = 0.005
    """Distance between neighboring nodes, m."""

    def nodes(self) -> Array:
        """Return the nodes row by row, where x changes fastest, m, shape (g, 2)."""
        k = int(np.floor(self.half_width / self.step + 1e-9))
        ticks = self.step * np.arange(-k, k + 1)
        y, x = np.meshgrid(self.middle[1] + ticks, self.middle[0] + ticks, indexing="ij")
        return np.stack((x.ravel(), y.ravel()), axis=-1)


def grid_center(points: ArrayLike, grid: Grid) -> Array:
    r"""Return the grid node with the smallest variance of distances, for each point set.

    .. math:: J(p) = \sum_n d_n^2 - \Big(\sum_n d_n\Big)^2 / N, \qquad d_n = |p - x_n|

    Source: Akbarifar et al. 2021, section 2-1-2 and equation 9. The index and the mean of the
    published equation are corrected.

    Parameters
    ----------
    points : array_like, shape (..., N, 2)
        One marker over N frames, m; no NaN.
    grid : Grid
        Nodes of the search.

    Returns
    -------
    ndarray, shape (..., 2)
        Node with the smallest cost J, m. If several nodes have the same cost, the first in row
        order is returned.
    """
    p = np.asarray(points, dtype=np.float64)
    flat = p.reshape(-1, *p.shape[-2:])
    nodes = grid.nodes()
    size = max(1, _AT_ONCE // max(len(nodes) * p.shape[-2], 1))
    parts = [flat[i : i + size] for i in range(0, len(flat), size)]
    best = [nodes[np.argmin(grid_cost(part, nodes), axis=-1)] for part in parts]

    return np.concatenate(best).reshape(*p.shape[:-2], 2) if best else np.zeros((*p.shape[:-2], 2))


def grid_cost(points: ArrayLike, nodes: Array) -> Array:
    """Return J at every node, m², shape (..., g), for points of shape (..., N, 2)."""
    p = np.asarray(points, dtype=np.float64)
    frames = p.shape[-2]
    square, total = np.zeros((2, *p.shape[:-2], len(nodes)))
    for n in range(frames):  # a loop is five times faster than one large array
        distance = (p[..., n, 0, None] - nodes[:, 0]) ** 2
        distance += (p[..., n, 1, None] - nodes[:, 1]) ** 2
        square += distance
        total += np.sqrt(distance, out=distance)
    return np.asarray(square - total**2 / frames)
