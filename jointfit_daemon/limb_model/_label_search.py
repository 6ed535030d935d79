"""Search for exchanged marker labels in single frames, from clusters and their joint centers.

A hypothesis assigns a measured label to every marker of a cluster. Its cost is the negative
logarithm of its likelihood. Marker errors are assumed to be Gaussian. An exchanged label is less
probable than a correct label, and a label that is at no marker position of a cluster is even less
probable. If a cluster has nearly the same shape after an exchange, the residuals hardly show the
exchange. However, the exchange rotates the fitted cluster, and the joint centers of the cluster
then differ from the joint centers of the adjacent clusters.

The *static world* is the optical world as it was during the static pose.

Invariant: an explanation is unique, because the cost of every other hypothesis is higher by at
least `_MARGIN`. A search consists of short parts, which `LabelExamination` spreads over frames.
"""

from __future__ import annotations

from collections import Counter
from itertools import combinations, pairwise, permutations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.limb_model._rigid_fit import MAX_FIT_RMS_M, MIN_MARKERS, is_line
from jointfit_daemon.name_lists import join_words

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model._marker_cluster import MarkerCluster

    Rows = NDArray[np.intp]

SUSPICIOUS_M = 0.012
"""RMS residual of a cluster above which its labels are always searched, m."""
SMALLEST_M = 0.004
"""RMS residual below which labels are never searched, m. It is the noise of markers on skin."""
DISPLACED_M = 0.02
"""RMS residual of a cluster above which a single marker may be displaced, m. It equals
`ACCEPTED_RMS_M` of ``kinematics.accepted_errors``; soft-tissue artefact does not exceed it for
long."""
_SYMMETRY = 0.6
"""RMS residual above which labels are searched, relative to the smallest RMS residual that an
exchange within the cluster causes."""
_MARKER_SD_M = 0.006
"""Standard deviation of a marker's error, including soft-tissue artefact, m."""
_EXCHANGED_COST = 2.0
"""Cost of a marker with the label of another marker."""
_ELSEWHERE_COST = 12.0
"""Cost of a visible label that is at no marker position of a cluster."""
_MARGIN = 2.5
"""Smallest difference between the costs of the best and the next explanation."""
_GAIN = 0.55
"""Largest RMS residual of an explanation, relative to the RMS residual of the unchanged labels."""
_SMALL_M = 0.008
"""RMS residual below which an explanation is always accepted, m."""
_LARGE_M = 0.02
"""RMS residual above which an explanation is always rejected, m."""
GAP_M = 0.08
"""Distance of the two centers of a joint above which labels are searched, m."""
_GAP_SD_M = 0.03
"""Standard deviation of the distance of the two centers, including soft-tissue artefact, m."""
_MOST_GAP_COST = 12.0
"""Largest cost of the distance of the centers at one joint, equal to `_ELSEWHERE_COST`."""
_NEAR_M = 0.025
"""RMS residual below which a label is considered to be at the position of a hidden marker, m."""
_TOLERANCE_M = 0.03
"""Largest difference between the distances of two markers in the frame and in the cluster, m."""
_MOST_COMPARED = 12
"""Largest number of markers in a cluster for which all exchanges, about 5000, are compared. The
number of exchanges grows with the fourth power of the number of markers. In a larger cluster, each
marker is exchanged only with its nearest marker."""
_MOST_CHANGED = 4
"""Largest number of changed labels in one cluster."""
_BEST = 16
"""Number of assignments of one cluster that are combined with the assignments of other clusters."""
_MOST_COMBINED = 2000
"""Largest number of partial combinations. A limb without faults has only a few."""
_COMBINED_AT_ONCE = 150
"""Number of partial combinations in one part of a search."""
_SAMPLED = 40
"""Number of frames of a trial in which labels are searched."""
_CONFIRMED = 0.5
"""Fraction of the suspicious frames of a trial that a fault must explain."""


class LabelFault(NamedTuple):
    """Labels of one frame that are not at the positions of their markers."""

    markers: tuple[str, ...]
    """Names of the markers. Each label is at the position of the next marker, and the last label at
    the position of the first marker. If there is only one name, this label is at no marker position
    of a cluster."""
    parts: tuple[str, ...]
    """Body parts of the markers, sorted."""
    cycle: bool = True
    """Whether the last label is at the position of the first marker. If False, the last marker is
    hidden."""

    @property
    def places(self) -> str:
        """Return a clause on the positions of the markers."""
        names = self.markers
        following = zip(names, names[1:] + (names[:1] if self.cycle else ()), strict=False)
        return join_words(f"{name} is at the place of {other}" for name, other in following)

    @property
    def text(self) -> str:
        """Return a sentence on two or more markers, without a full stop."""
        if self.cycle:
            return f"{join_words(self.markers)} look exchanged: {self.places}"
        names = join_words(self.markers[:-1])
        ends = f"{self.places}, which is hidden"
        if len(self.markers) == 2:
            return f"{names} has the label of another marker: {ends}"
        return f"{names} have labels of other markers: {ends}"


class LabelFinding(NamedTuple):
    """Result of the search in one frame."""

    rms: Array
    """RMS residual of each cluster with the unchanged labels, m, shape (P,); NaN without a fit."""
    faults: tuple[LabelFault, ...]


class _Frame(NamedTuple):
    """Markers of one frame. The last row is NaN and belongs to no marker."""

    points: Array
    """Positions of the markers, m, shape (M + 1, 3)."""
    seen: NDArray[np.bool_]
    distances: Array
    """Distances of all pairs, m, shape (M + 1, M + 1)."""


class _Assignment(NamedTuple):
    """Assignment of labels to the markers of one cluster, which is part of a hypothesis."""

    columns: tuple[int, ...]
    """Column of the label of each marker; -1 for a hidden or displaced marker."""
    cost: float
    centers: Array
    """Joint centers fixed in the cluster, m, shape (J, 3); NaN for other joints."""


class _Fits(NamedTuple):
    """Rigid fits of n sets of markers."""

    rms: Array
    """RMS residual of each fit, m, shape (n,)."""
    rotation: Array
    """Rotation from the template to the frame, shape (n, 3, 3)."""
    template_mean: Array
    mean: Array
    """Means of the markers in template and frame, m, shape (n, 3)."""

    def carry(self, points: Array) -> Array:
        """Transform points of the template to the frame, m, shape (n, J, 3)."""
        turned = (points - self.template_mean[:, None]) @ np.swapaxes(self.rotation, 1, 2)
        return np.asarray(turned + self.mean[:, None])


class LabelSearch:
    """Explains the markers of one frame by exchanged labels.

    Parameters
    ----------
    clusters : iterable of MarkerCluster
        Marker clusters. Rigid bodies are ignored.
    centers : mapping of tuple of str to ndarray, optional
        Joint centers in the static world, m, shape (3,), by the two body parts of each joint.
    """

    def __init__(
        self,
        clusters: Iterable[MarkerCluster],
        centers: Mapping[tuple[str, str], Array] | None = None,
    ) -> None:
        self.clusters = tuple(cluster for cluster in clusters if cluster.body is None)
        self.labels = tuple(name for cluster in self.clusters for name in cluster.markers)
        self._part_of = [p for p, cluster in enumerate(self.clusters) for _ in cluster.markers]
        ends = np.cumsum([0, *(len(cluster.markers) for cluster in self.clusters)])
        self._own = [np.arange(a, b) for a, b in pairwise(ends)]
        """Columns of the markers of each cluster."""

        # Clusters of different sizes are in one array, whose unused rows have the weight 0.
        most = max((len(own) for own in self._own), default=0)
        self._template = np.zeros((len(self.clusters), most, 3))
        self._columns = np.full((len(self.clusters), most), -1)
        for p, (own, cluster) in enumerate(zip(self._own, self.clusters, strict=True)):
            self._template[p, : len(own)] = cluster.template
            self._columns[p, : len(own)] = own

        # Joint centers in the coordinates of the templates; NaN if the part is not adjacent to the
        # joint.
        given = {} if centers is None else centers
        self._centers = np.full((len(self.clusters), len(given), 3), np.nan)
        for j, (parts, center) in enumerate(given.items()):
            for p, cluster in enumerate(self.clusters):
                if cluster.name in parts:
                    self._centers[p, j] = center - cluster.origin
        self._lines: dict[tuple[int, bytes], bool] = {}
        self._limits = np.array([_suspicious_rms(cluster.template) for cluster in self.clusters])

    def explain(self, points: Array) -> LabelFinding:
        """Return the residuals of the clusters in one frame, and label faults that explain them.

        Parameters
        ----------
        points : ndarray, shape (M, 3)
            Marker positions in the order of `labels`, m; NaN if hidden.
        """
        parts = self.parts(points)
        while True:
            try:
                next(parts)
            except StopIteration as end:
                finding: LabelFinding = end.value
                return finding

    def parts(self, points: Array) -> Generator[None, None, LabelFinding]:
        """Search like `explain`, and yield between the parts of the search.

        The first part fits all clusters; if they fit, the search ends. Then each suspect cluster is
        one part. The combinations of the assignments of these clusters are divided into further
        parts.
        """
        padded = np.concatenate((points, np.full((1, 3), np.nan)))
        seen = np.isfinite(padded).all(axis=1)
        if not len(self.clusters):
            return LabelFinding(np.zeros(0), ())
        fits = _fit(self._template, padded[self._columns], seen[self._columns])
        rms, centers = fits.rms, fits.carry(self._centers)

        # Clusters with too few visible markers, or with markers on a line, have no pose.
        fitted = np.array(
            [
                seen[own].sum() >= MIN_MARKERS and not self._is_line(p, seen[own])
                for p, own in enumerate(self._own)
            ]
        )
        rms[~fitted], centers[~fitted] = np.nan, np.nan

        # A cluster is suspect if its markers do not fit, or if the two centers of one of its joints
        # are far apart.
        suspect = rms > self._limits
        for at in np.swapaxes(centers, 0, 1):
            (beside,) = np.nonzero(np.isfinite(at[:, 0]))
            if len(beside) > 1 and np.linalg.norm(at[beside[0]] - at[beside[1]]) > GAP_M:
                suspect[beside] = True
        if not suspect.any():
            return LabelFinding(rms, ())
        yield
        faults = yield from self._faults(padded, seen, rms, centers, suspect)
        return LabelFinding(rms, faults)

    def neighbors(self, parts: Iterable[str]) -> frozenset[str]:
        """Return the body parts that share a joint with any of `parts`."""
        rows = [p for p, cluster in enumerate(self.clusters) if cluster.name in set(parts)]
        shared = np.isfinite(self._centers[rows, :, 0]).any(axis=0)
        near = np.isfinite(self._centers[:, shared, 0]).any(axis=1)
        return frozenset(self.clusters[p].name for p in np.flatnonzero(near))

    def _faults(
        self,
        points: Array,
        seen: NDArray[np.bool_],
        rms: Array,
        centers: Array,
        suspect: NDArray[np.bool_],
    ) -> Generator[None, None, tuple[LabelFault, ...]]:
        suspects = np.flatnonzero(suspect).tolist()
        distances = np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=-1))
        frame = _Frame(points, seen, distances)
        pool = np.concatenate([self._own[p][seen[self._own[p]]] for p in suspects])
        options = []
        for p in suspects:
            each = self._assignments(p, frame, pool, float(rms[p]))
            known = _gap_costs(np.array([one.centers for one in each]), centers[~suspect])
            costs = [one.cost for one in each] + known.sum(axis=1)
            options.append(
                [one._replace(cost=cost) for one, cost in zip(each, costs.tolist(), strict=True)]
            )
            yield
        best = yield from _combine(options)
        if best is None:
            return ()

        place_of: dict[int, int] = {}
        elsewhere: list[int] = []
        for p, columns in zip(suspects, best, strict=True):
            own = self._own[p].tolist()
            place_of |= {c: s for c, s in zip(columns, own, strict=True) if c not in (-1, s)}
            kept = {c for others in best for c in others}
            # A fit without one marker always has a smaller residual. Such a marker therefore counts
            # as displaced only if soft-tissue artefact cannot explain the residual of all markers.
            if rms[p] > DISPLACED_M:
                elsewhere += [s for s in own if seen[s] and s not in kept]
        for label in elsewhere:
            hidden = self._hidden_place(points, seen, rms, suspects, label)
            if hidden is not None:
                place_of[label] = hidden
        return tuple(self._groups(place_of, elsewhere))

    def _assignments(self, p: int, frame: _Frame, pool: Rows, rms: float) -> list[_Assignment]:
        """Return the best assignments of one cluster, with the unchanged labels first.

        Labels are added marker by marker. An assignment is dropped if the distance of two markers
        differs from their distance in the cluster by `_TOLERANCE_M` or more.
        """
        own, template, seen = self._own[p], self.clusters[p].template, frame.seen
        apart = np.sqrt(((template[:, None] - template[None]) ** 2).sum(axis=-1))
        options = np.append(pool, -1)
        most_hidden = int((~seen[own]).sum()) + 1
        found: Rows = np.zeros((1, 0), dtype=np.intp)
        for s in range(len(own)):
            # Extend every assignment by the next marker, with each label and without a label.
            grown = np.column_stack(
                (np.repeat(found, len(options), axis=0), np.tile(options, len(found)))
            )
            new, before = grown[:, -1:], grown[:, :-1]
            off = np.abs(frame.distances[new, before] - apart[s, :s])

            # Keep assignments with the distances of the cluster, different labels and few changes.
            fits = ((off < _TOLERANCE_M) | (new < 0) | (before < 0)).all(axis=1)
            fits &= ((new != before) | (new < 0)).all(axis=1)
            fits &= (grown < 0).sum(axis=1) <= most_hidden
            visible_change = (grown != own[: s + 1]) & ((grown >= 0) | seen[own[: s + 1]])
            found = grown[fits & (visible_change.sum(axis=1) <= _MOST_CHANGED)]

        used = found >= 0
        enough = used.sum(axis=1) >= MIN_MARKERS
        found, used = found[enough], used[enough]
        identity = np.where(seen[own], own, -1)
        # The unchanged labels come first.
        found = np.concatenate(([identity], found))
        used = np.concatenate(([seen[own]], used))
        fits = _fit(np.broadcast_to(template, (*found.shape, 3)), frame.points[found], used)
        after, centers = fits.rms, fits.carry(self._centers[p])
        changed, count = ((found != own) & used).sum(axis=1), used.sum(axis=1)
        cost = _cost(after, count) + _EXCHANGED_COST * changed
        cost += _ELSEWHERE_COST * (seen[own].sum() - count)

        small = after < min(max(_GAIN * rms, _SMALL_M), _LARGE_M)
        good = small & (changed + ((found < 0) & seen[own]).sum(axis=1) > 0)
        order = np.flatnonzero(good)[np.argsort(cost[good], kind="stable")][: 4 * _BEST]
        kept = [i for i in order.tolist() if not self._is_line(p, used[i])][:_BEST]
        return [
            _Assignment(tuple(found[i].tolist()), float(cost[i]), centers[i]) for i in (0, *kept)
        ]

    def _is_line(self, p: int, used: NDArray[np.bool_]) -> bool:
        """Return whether the selected markers of a cluster are on a line."""
        key = (p, used.tobytes())
        if key not in self._lines:
            self._lines[key] = is_line(self.clusters[p].template[used])
        return self._lines[key]

    def _hidden_place(
        self,
        points: Array,
        seen: NDArray[np.bool_],
        rms: Array,
        suspects: Sequence[int],
        label: int,
    ) -> int | None:
        """Return the hidden marker at whose position a label is; None if not exactly one fits.

        Only clusters that are not suspect are searched.
        """
        found = []
        for p, own in enumerate(self._own):
            if p in suspects or not np.isfinite(rms[p]):
                continue
            for s in own[~seen[own]].tolist():
                columns = np.where(seen[own], own, -1)
                columns[s - own[0]] = label
                after = _fit(
                    self.clusters[p].template[None], points[columns][None], (columns >= 0)[None]
                ).rms[0]
                if after < _NEAR_M:
                    found.append(s)
        return found[0] if len(found) == 1 else None

    def _groups(self, place_of: dict[int, int], elsewhere: Sequence[int]) -> list[LabelFault]:
        """Return the chains and cycles of exchanged labels."""
        groups = []
        left = dict(place_of)
        ends = [c for c in place_of if c not in set(place_of.values())]  # open chains come first
        for first in [*ends, *sorted(place_of)]:
            group, c = [], first
            while c in left:
                group.append(c)
                c = left.pop(c)
            if not group:
                continue
            cycle = c == first
            groups.append(self._fault(group if cycle else [*group, c], cycle=cycle))
        grouped = {name for group in groups for name in group.markers}
        return groups + [
            self._fault([c], cycle=False) for c in elsewhere if self.labels[c] not in grouped
        ]

    def _fault(self, columns: Sequence[int], *, cycle: bool) -> LabelFault:
        parts = sorted({self.clusters[self._part_of[c]].name for c in columns})
        return LabelFault(tuple(self.labels[c] for c in columns), tuple(parts), cycle)


def explain_trial(search: LabelSearch, positions: Array) -> tuple[LabelFault, ...]:
    """Return the label faults that explain most of the suspicious frames of a trial.

    Parameters
    ----------
    search : LabelSearch
        The clusters.
    positions : ndarray, shape (m, M, 3)
        Marker positions in the order of the labels of `search`, m; NaN if hidden.
    """
    rows = np.unique(np.linspace(0, len(positions) - 1, _SAMPLED).astype(int))
    findings = [search.explain(positions[row]) for row in rows if len(positions)]
    votes = Counter(fault for finding in findings for fault in finding.faults)
    names = [cluster.name for cluster in search.clusters]
    confirmed = []
    for fault, count in votes.items():
        # Count the frames in which a cluster of the fault does not fit, or that the fault explains.
        parts = [names.index(part) for part in fault.parts]
        suspicious = sum(
            bool((finding.rms[parts] > MAX_FIT_RMS_M).any()) or fault in finding.faults
            for finding in findings
        )
        if count > _CONFIRMED * suspicious:
            confirmed.append(fault)
    return tuple(confirmed)


def _suspicious_rms(template: Array) -> float:
    """Return the RMS residual above which the labels of a cluster are searched, m.

    The threshold is smaller for a cluster that has almost the same shape after an exchange of
    labels.
    """
    count = len(template)
    if count <= _MOST_COMPARED:
        orders = [
            order
            for moved in (2, 3, 4)
            for rows in combinations(range(count), moved)
            for order in _orders(count, rows)
        ]
    else:
        # With many markers a rigid fit hardly adapts to one exchange, so only close markers are
        # tested.
        distances = np.linalg.norm(template[:, None] - template, axis=2)
        np.fill_diagonal(distances, np.inf)
        pairs = {(min(a, b), max(a, b)) for a, b in enumerate(distances.argmin(axis=1).tolist())}
        orders = [order for rows in sorted(pairs) for order in _orders(count, rows)]
    if not orders:
        return SUSPICIOUS_M
    tiled = np.broadcast_to(template, (len(orders), count, 3))
    seen = np.ones((len(orders), count), dtype=np.bool_)
    least = float(_fit(tiled, template[np.array(orders)], seen).rms.min())
    return max(SMALLEST_M, min(SUSPICIOUS_M, _SYMMETRY * least))


def _orders(count: int, rows: tuple[int, ...]) -> list[list[int]]:
    """Return the permutations of a cluster that move exactly these rows."""
    found = []
    for order in permutations(rows):
        if all(a != b for a, b in zip(rows, order, strict=True)):
            whole = list(range(count))
            for a, b in zip(rows, order, strict=True):
                whole[a] = b
            found.append(whole)
    return found


def _fit(template: Array, points: Array, seen: NDArray[np.bool_]) -> _Fits:
    r"""Return the rigid fits of n sets of k markers (Kabsch 1976).

    If s are the singular values of the cross moment, the sum of squared residuals is
    :math:`\sum |a|^2 + \sum |y|^2 - 2 (s_1 + s_2 \pm s_3)`.

    Parameters
    ----------
    template, points : ndarray, shape (n, k, 3)
        Markers of the cluster and of the frame, m.
    seen : ndarray, shape (n, k)
        Mask of the markers to fit.
    """
    w = seen[..., None]
    count = np.maximum(seen.sum(axis=1), 1)[:, None]
    a, y = np.where(w, template, 0.0), np.where(w, points, 0.0)
    a_mean, y_mean = a.sum(axis=1) / count, y.sum(axis=1) / count
    a, y = np.where(w, a - a_mean[:, None], 0.0), np.where(w, y - y_mean[:, None], 0.0)
    u, s, vt = np.linalg.svd(np.swapaxes(a, 1, 2) @ y)
    sign = np.sign(np.linalg.det(u @ vt))
    s[:, 2] *= sign
    vt[:, 2] *= sign[:, None]
    square = (a * a).sum(axis=(1, 2)) + (y * y).sum(axis=(1, 2)) - 2.0 * s.sum(axis=1)
    rms = np.sqrt(np.maximum(square, 0.0) / count[:, 0])
    return _Fits(rms, np.swapaxes(u @ vt, 1, 2), a_mean, y_mean)


def _gap_costs(one: Array, other: Array) -> Array:
    """Return the costs of the distances between the joint centers of two clusters, shape (n, m).

    Parameters
    ----------
    one, other : ndarray, shapes (n, J, 3) and (m, J, 3)
        Joint centers of n assignments of one cluster, and of m assignments of another cluster, m.
    """
    square = ((one[:, None] - other[None]) ** 2).sum(axis=-1) / (2.0 * _GAP_SD_M**2)
    return np.asarray(np.nansum(np.minimum(square, _MOST_GAP_COST), axis=-1))


def _cost(rms: Array, count: Array) -> Array:
    cost: Array = count * (rms / _MARKER_SD_M) ** 2 / 2.0
    return cost


def _combine(
    options: Sequence[Sequence[_Assignment]],
) -> Generator[None, None, list[tuple[int, ...]] | None]:
    """Return the assignments with the least cost in which no label is used twice.

    The result is None if no label is changed, if the cost of another combination is almost as low,
    or if there are more than `_MOST_COMBINED` partial combinations.
    """
    # Each mask contains the columns of an assignment as bits.
    masks = [[sum(1 << c for c in one.columns if c >= 0) for one in each] for each in options]
    orders = [np.argsort([-one.cost for one in each]).tolist() for each in options]
    rest = [0.0]  # least cost of the clusters that have no assignment yet
    for each in reversed(options):
        rest.append(rest[-1] + min(one.cost for one in each))
    rest.reverse()

    # Costs of the joints between two clusters, for every pair of their assignments.
    centers = [np.array([one.centers for one in each]) for each in options]
    gaps = {
        (q, p): _gap_costs(centers[q], centers[p]).tolist()
        for q, p in combinations(range(len(options)), 2)
        if np.isfinite(centers[q][0] + centers[p][0]).any()
    }

    found: list[tuple[float, tuple[int, ...]]] = []
    best, visited = np.inf, 0
    stack: list[tuple[float, int, tuple[int, ...]]] = [(0.0, 0, ())]
    while stack and (visited := visited + 1) <= _MOST_COMBINED:
        if not visited % _COMBINED_AT_ONCE:
            yield
        cost, taken, chosen = stack.pop()
        p = len(chosen)
        cost += sum(
            gaps[q, p - 1][chosen[q]][chosen[-1]] for q in range(p - 1) if (q, p - 1) in gaps
        )
        if cost + rest[p] > best + _MARGIN:
            continue
        if p == len(options):
            best = min(best, cost)
            found.append((cost, chosen))
            continue
        stack += [
            (cost + options[p][i].cost, taken | masks[p][i], (*chosen, i))
            for i in orders[p]  # the assignment with the least cost is last and is visited first
            if not taken & masks[p][i]
        ]
    close = [chosen for cost, chosen in sorted(found) if cost <= best + _MARGIN]
    if visited > _MOST_COMBINED or len(close) != 1 or not any(close[0]):
        return None
    return [options[p][i].columns for p, i in enumerate(close[0])]
