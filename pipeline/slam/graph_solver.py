"""Solution of the graph of keyframes and stems: Levenberg-Marquardt with most stems eliminated.

Each stem is seen by some keyframes and by no other stem, so that its unknowns l are eliminated one stem at a
time (Schur complement; Triggs et al. 2000, Bundle Adjustment, section 6.1). With the normal equations

    [U    W ] [dx]     [g_x]
    [W^T  V ] [dl] = - [g_l],        V block diagonal,

    (U - W V^-1 W^T) dx = -g_x + W V^-1 g_l,        dl = -V^-1 (g_l + W^T dx).

Two keyframes are coupled if they see a common eliminated stem. In the order of Cuthill and McKee these are
near each other, so that the envelope of the reduced matrix is small. A stem that more than VIEWS_MAX
keyframes see would couple too many of them; it remains an unknown, behind all poses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.geometry.envelope import Envelope, Factor
from pipeline.geometry.poses import Float, wrap_angle
from pipeline.jit import compiled
from pipeline.types.records import Int

if TYPE_CHECKING:
    from pipeline.slam.keyframe_graph import KeyframeGraph

#: Scale of the Cauchy kernel [sigma]: 95 % of the efficiency of least squares for Gaussian errors (Holland,
#: Welsch 1977).
CAUCHY = 2.385
MOTION_SIGMA_MIN = np.array([1e-3, 1e-3, 1e-4])  # m, m, rad; lower bound, for a robot that does not move
#: Decrease of the cost that ends the iteration. The cost is a sum of squared sigmas, so that the solution is
#: within about a tenth of a sigma of the minimum, however many detections there are.
CONVERGED = 0.01
ITERATIONS_MAX = 50
#: First and least value, factor, and the value at which the solver fails. A chain of K poses bends with
#: 1 / K^4 of its stiffness (that of a beam), 1e-13 for 2,000 keyframes: a larger damping, which is relative
#: to the diagonal, holds the bend. The least value is the precision of the numbers.
DAMPING, DAMPING_MIN, DAMPING_FACTOR, DAMPING_MAX = 1e-9, 1e-15, 10.0, 1e6
FIXED = 1e8  # 1/m^2, 1/rad^2; information that holds the first pose, which is the frame of the map
REGULAR = 1e-9  # 1/m^2, 1/rad^2; information of a pose or stem that nothing observes
SIDE = 48  # rows of a block of the reduced matrix
#: Most keyframes that see a stem which is eliminated. Coupling n keyframes costs up to 9 n^3 products, a stem
#: that remains costs two rows over all poses. In a forest, 5 to 60 keyframes see most stems; at a place to
#: which the robot returns all the time, hundreds do.
VIEWS_MAX = 256
MARGINALS = 16  # keyframes whose covariance is computed; it is interpolated in between


class MatrixLayout(NamedTuple):
    """Places of the unknowns in the reduced matrix.

    Attributes:
        pose: First unknown of each pose, int64, shape (K,).
        stem: First unknown of each stem that remains, -1 for an eliminated one, int64, shape (L,).
        first, width, offset: See Envelope.
    """

    pose: Int
    stem: Int
    first: Int
    width: Int
    offset: Int


class Normal(NamedTuple):
    """Normal equations of K poses, L stems, E motions and loops, and M detections.

    Attributes:
        U: Blocks of the poses on the diagonal, shape (K, 3, 3).
        edge: Block of each motion and loop, of its second pose by its first one, shape (E, 3, 3).
        W: Block of each detection, of its pose by its stem, shape (M, 3, 2).
        V: Blocks of the stems xx, xy, yy, shape (L, 3).
        g_x, g_l: Gradient, shapes (K, 3) and (L, 2).
    """

    U: Float
    edge: Float
    W: Float
    V: Float
    g_x: Float
    g_l: Float


class Problem:
    """A graph as arrays of K poses, L stems, E motions and loops, and M detections, by stem."""

    def __init__(self, graph: KeyframeGraph) -> None:
        """Convert a graph with at least two keyframes. Stems with a single detection are omitted, and so are
        motions with infinite covariance.

        Raises:
            LinAlgError: A covariance is not positive definite.
        """
        keyframes = graph.keyframes
        birth = np.concatenate([k.birth for k in keyframes])
        row = np.repeat(np.arange(len(keyframes)), [len(k.birth) for k in keyframes])
        names, of, count = np.unique(birth, return_inverse=True, return_counts=True)
        self.birth = names[count > 1]
        by_stem = np.argsort(of, kind="stable")
        by_stem = by_stem[count[of[by_stem]] > 1]  # a single view of a stem does not constrain a pose
        self.row = row[by_stem]
        self.of = np.searchsorted(self.birth, birth[by_stem])
        self.begin = np.searchsorted(self.of, np.arange(len(self.birth) + 1))
        self.z = np.concatenate([k.centre for k in keyframes])[by_stem]
        R = np.concatenate([k.R for k in keyframes])[by_stem]
        self.root_R = _root_information(R[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
        self.pose = graph.pose
        # Motions by odometry, then loops.
        connected = [k for k in range(1, len(keyframes)) if np.isfinite(keyframes[k].covariance).all()]
        scans = graph.scans
        ends = [np.searchsorted(scans, e.scans) for e in graph.loops]
        self.motions = len(connected)
        self.first = np.array([k - 1 for k in connected] + [i for i, _ in ends], np.int64)
        self.second = np.array(connected + [j for _, j in ends], np.int64)
        motion = [keyframes[k].motion for k in connected] + [e.motion for e in graph.loops]
        covariance = [keyframes[k].covariance for k in connected] + [e.covariance for e in graph.loops]
        self.u = np.array(motion).reshape(-1, 3)
        floor = np.diag(np.square(MOTION_SIGMA_MIN))
        self.root_Q = _root_information(np.array(covariance).reshape(-1, 3, 3) + floor)
        self.layout, self.envelope = self._elimination_order()

    def _elimination_order(self) -> tuple[MatrixLayout, Envelope]:
        """Return the layout of the unknowns in the reduced matrix, and its envelope."""
        from scipy import sparse
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        K, L, E = len(self.pose), len(self.birth), len(self.first)
        remains = np.diff(self.begin) > VIEWS_MAX
        stem = np.where(remains, 3 * K + 2 * (np.cumsum(remains) - 1), -1)
        kept = remains[self.of]  # detections of the stems that remain
        row, of = self.row[~kept], self.of[~kept]
        seen = sparse.csr_matrix((np.ones(len(row)), (row, of)), shape=(K, L))
        edges = sparse.csr_matrix((np.ones(E), (self.first, self.second)), shape=(K, K))
        coupled = (seen @ seen.T + edges + edges.T).tocsr()
        pose = np.empty(K, np.int64)
        pose[reverse_cuthill_mckee(coupled, symmetric_mode=True)] = 3 * np.arange(K)
        pairs = coupled.tocoo()
        rows = [pose[pairs.row] + p for p in range(3)] + [stem[self.of[kept]] + q for q in range(2)]
        columns = [pose[pairs.col]] * 3 + [pose[self.row[kept]]] * 2
        count = 3 * K + 2 * int(remains.sum())
        envelope = Envelope.of(np.concatenate(rows), np.concatenate(columns), count, SIDE)
        return MatrixLayout(pose, stem, envelope.first, envelope.width, envelope.offset), envelope

    def minimum(self, quadratic_loops: int = 0) -> tuple[Float, Float, Normal] | None:
        """Minimise the cost by Levenberg-Marquardt from the poses in `pose`. After ITERATIONS_MAX steps the
        iteration ends without a test of convergence.

        Args:
            quadratic_loops: Number of loops at the end that have no Cauchy kernel.

        Returns:
            Poses, shape (K, 3), yaw wrapped; positions of the stems, shape (L, 2) [m]; and normal equations
            at the minimum. None if no damping below its limit makes them regular and decreases the cost.
        """
        x, l = self.pose.copy(), self._triangulated()  # noqa: E741
        cost, normal = self._linearised(x, l, quadratic_loops)
        damping = DAMPING
        for _ in range(ITERATIONS_MAX):
            moved, placed, new_cost, new_normal = x, l, np.inf, normal
            if (step := self._step(normal, damping)) is not None:
                moved, placed = x + step[0], l + step[1]
                new_cost, new_normal = self._linearised(moved, placed, quadratic_loops)
            if not new_cost <= cost * (1.0 + 1e-9):  # a NaN is no decrease
                damping *= DAMPING_FACTOR
                if damping > DAMPING_MAX:
                    return None
                continue
            converged = cost - new_cost < CONVERGED
            x, l, cost, normal = moved, placed, new_cost, new_normal  # noqa: E741
            damping = max(damping / DAMPING_FACTOR, DAMPING_MIN)
            if converged:
                break
        x[:, 2] = wrap_angle(x[:, 2])
        return x, l, normal

    def _triangulated(self) -> Float:
        """Return the mean position of each stem by its detections at the poses in `pose`, shape (L, 2)
        [m]."""
        c, s = np.cos(self.pose[self.row, 2]), np.sin(self.pose[self.row, 2])
        x = self.pose[self.row, 0] + c * self.z[:, 0] - s * self.z[:, 1]
        y = self.pose[self.row, 1] + s * self.z[:, 0] + c * self.z[:, 1]
        n = np.bincount(self.of, minlength=len(self.birth))
        return np.column_stack([np.bincount(self.of, v, len(self.birth)) for v in (x, y)]) / n[:, None]

    def _linearised(
        self,
        x: Float,
        l: Float,  # noqa: E741
        quadratic_loops: int,
    ) -> tuple[float, Normal]:
        """Return robust cost and normal equations at an estimate.

        Args:
            x: Poses, shape (K, 3).
            l: Stems, shape (L, 2) [m].
            quadratic_loops: Number of loops at the end that have no Cauchy kernel.
        """
        K, L, E = len(x), len(l), len(self.first)
        i, j = self.first, self.second
        c, s = np.cos(x[i, 2]), np.sin(x[i, 2])
        dx, dy = (x[j, :2] - x[i, :2]).T
        e = np.column_stack([c * dx + s * dy, c * dy - s * dx, x[j, 2] - x[i, 2]]) - self.u
        e[:, 2] = wrap_angle(e[:, 2])
        J = np.zeros((2, E, 3, 3))
        J[1, :, 0, 0], J[1, :, 0, 1], J[1, :, 1, 0], J[1, :, 1, 1], J[1, :, 2, 2] = c, s, -s, c, 1.0
        J[0] = -J[1]
        J[0, :, 0, 2], J[0, :, 1, 2] = c * dy - s * dx, -c * dx - s * dy
        e, J = (self.root_Q @ e[:, :, None])[:, :, 0], self.root_Q @ J
        d2 = np.einsum("ea,ea->e", e, e)
        weight, cost = np.ones(E), d2.copy()
        robust = slice(self.motions, E - quadratic_loops)
        weight[robust] = cauchy_weight(d2[robust])
        cost[robust] = CAUCHY**2 * np.log1p(d2[robust] / CAUCHY**2)
        J, e = np.sqrt(weight)[:, None, None] * J, np.sqrt(weight)[:, None] * e

        U, g_x = np.zeros((K, 3, 3)), np.zeros((K, 3))
        for n, ends in enumerate((i, j)):
            np.add.at(U, ends, J[n].transpose(0, 2, 1) @ J[n])
            np.add.at(g_x, ends, np.einsum("eai,ea->ei", J[n], e))
        edge = J[1].transpose(0, 2, 1) @ J[0]
        normal = Normal(U, edge, np.empty((len(self.row), 3, 2)), np.zeros((L, 3)), g_x, np.zeros((L, 2)))
        of_stems = _add_detections(x, l, self.row, self.of, self.z, self.root_R, normal)
        return float(cost.sum()) + of_stems, normal

    def _step(self, normal: Normal, damping: float) -> tuple[Float, Float] | None:
        """Return the Levenberg-Marquardt step of the poses, shape (K, 3), and of the stems, shape (L, 2).

        It is None if the system is singular or the step is not finite. `damping` is relative to the diagonal.
        The first pose is held, so that the free frame of the map does not make the system singular.
        """
        try:
            factor, right, inverse_V = self._reduced(normal, damping)
        except np.linalg.LinAlgError:
            return None
        step = -factor.solve(right)
        dx = step[self.layout.pose[:, None] + np.arange(3)]
        dl = _stem_steps(normal, inverse_V, self.row, self.begin, self.layout, step)
        return (dx, dl) if np.isfinite(dx).all() and np.isfinite(dl).all() else None

    def _reduced(self, normal: Normal, damping: float) -> tuple[Factor, Float, Float]:
        """Eliminate the stems and factorise the rest.

        Args:
            normal: Normal equations, unchanged.
            damping: Share of the diagonal that is added to it.

        Returns:
            Factor of the reduced matrix; reduced gradient in the same order, shape (N,); and inverse blocks
            of the eliminated stems xx, xy, yy, shape (L, 3).

        Raises:
            LinAlgError: The reduced matrix is not positive definite.
        """
        values, right = np.zeros(self.envelope.offset[-1]), np.zeros(self.envelope.count)
        _write_poses(normal, self.first, self.second, self.layout, damping, values, right)
        inverse_V = _write_stems(normal, self.row, self.begin, self.layout, damping, values, right)
        return Factor(values, self.envelope), right, inverse_V

    def marginals(self, normal: Normal) -> tuple[Float, Float]:
        """Return `covariance` and `of_map` of the solution, shape (K, 3, 3) each. They are computed from the
        normal equations for the second and at most MARGINALS other keyframes, and interpolated linearly by
        row in between.

        Raises:
            LinAlgError: The normal equations are singular.
        """
        K = len(self.pose)
        factor, _, _ = self._reduced(normal, 0.0)
        chosen = np.unique(np.r_[1, np.linspace(0, K - 1, min(K, MARGINALS)).round().astype(np.int64)])
        rows = self.layout.pose[chosen, None] + np.arange(3)
        unit = np.zeros((self.envelope.count, rows.size))
        unit[rows.ravel(), np.arange(rows.size)] = 1.0
        inverse = factor.solve(unit)
        blocks = np.array([inverse[at, 3 * n : 3 * n + 3] for n, at in enumerate(rows)])
        blocks = 0.5 * (blocks + blocks.transpose(0, 2, 1))
        given_others = np.linalg.inv(normal.U[chosen] + REGULAR * np.eye(3))
        values, axes = np.linalg.eigh(blocks - given_others)
        of_map = (axes * np.maximum(values, 0.0)[:, None, :]) @ axes.transpose(0, 2, 1)
        return _interpolated(chosen, blocks, K), _interpolated(chosen[1:], of_map[1:], K)


@compiled
def _add_detections(
    x: Float,
    l: Float,  # noqa: E741
    row: Int,
    of: Int,
    z: Float,
    root_R: Float,
    normal: Normal,
) -> float:
    """Add the detections to the normal equations, in place, and return their robust cost.

    Args:
        x: Poses, shape (K, 3).
        l: Stems, shape (L, 2) [m].
        row, of: Pose and stem of each detection, int64, shape (M,).
        z: Detections in the frame of their pose, shape (M, 2) [m].
        root_R: Roots of their information, upper triangular, shape (M, 2, 2).
        normal: Normal equations; all blocks of W are written.
    """
    cost = 0.0
    Jx, Jl = np.empty((2, 3)), np.empty((2, 2))
    for m in range(row.shape[0]):
        k, j = row[m], of[m]
        c, s = np.cos(x[k, 2]), np.sin(x[k, 2])
        dx, dy = l[j, 0] - x[k, 0], l[j, 1] - x[k, 1]
        h0, h1 = c * dx + s * dy, c * dy - s * dx
        a, b, d = root_R[m, 0, 0], root_R[m, 0, 1], root_R[m, 1, 1]
        e1 = d * (h1 - z[m, 1])
        e0 = a * (h0 - z[m, 0]) + b * (h1 - z[m, 1])
        d2 = (e0 * e0 + e1 * e1) / (CAUCHY * CAUCHY)
        cost += CAUCHY * CAUCHY * np.log1p(d2)
        weight = 1.0 / (1.0 + d2)
        Jl[0, 0], Jl[0, 1], Jl[1, 0], Jl[1, 1] = a * c - b * s, a * s + b * c, -d * s, d * c
        Jx[0, 2], Jx[1, 2] = a * h1 - b * h0, -d * h0
        for q in range(2):
            Jx[0, q], Jx[1, q] = -Jl[0, q], -Jl[1, q]
        for p in range(3):
            normal.g_x[k, p] += weight * (Jx[0, p] * e0 + Jx[1, p] * e1)
            for q in range(3):
                normal.U[k, p, q] += weight * (Jx[0, p] * Jx[0, q] + Jx[1, p] * Jx[1, q])
            for q in range(2):
                normal.W[m, p, q] = weight * (Jx[0, p] * Jl[0, q] + Jx[1, p] * Jl[1, q])
        normal.V[j, 0] += weight * (Jl[0, 0] * Jl[0, 0] + Jl[1, 0] * Jl[1, 0])
        normal.V[j, 1] += weight * (Jl[0, 0] * Jl[0, 1] + Jl[1, 0] * Jl[1, 1])
        normal.V[j, 2] += weight * (Jl[0, 1] * Jl[0, 1] + Jl[1, 1] * Jl[1, 1])
        for q in range(2):
            normal.g_l[j, q] += weight * (Jl[0, q] * e0 + Jl[1, q] * e1)
    return cost


@compiled
def _entry(row: int, column: int, layout: MatrixLayout) -> int:
    """Return where the entry of a row and a column up to it is stored."""
    block = row // SIDE
    start = layout.offset[block] - SIDE * layout.first[block]
    at: int = start + (row - SIDE * block) * layout.width[block] + column
    return at


@compiled
def _write_poses(
    normal: Normal, first: Int, second: Int, layout: MatrixLayout, damping: float, values: Float, right: Float
) -> None:
    """Write the blocks of poses, motions and loops into the reduced matrix.

    Args:
        normal: Normal equations.
        first, second: Poses of each motion and loop, int64, shape (E,).
        layout: Places of the unknowns.
        damping: Share of the diagonal that is added to it.
        values: Entries of the reduced matrix in the layout of the envelope, zeros at first; filled on and
            below the diagonal. Rows beyond the last unknown become those of the identity.
        right: Gradient in the order of the unknowns, shape (N,); filled for the poses.
    """
    place = layout.pose
    for k in range(place.shape[0]):
        for p in range(3):
            right[place[k] + p] = normal.g_x[k, p]
            at = _entry(place[k] + p, place[k], layout)
            for q in range(p + 1):
                values[at + q] += normal.U[k, p, q]
            values[at + p] += damping * normal.U[k, p, p] + REGULAR + (FIXED if k == 0 else 0.0)
    for e in range(first.shape[0]):
        i, j = place[first[e]], place[second[e]]
        for p in range(3):
            at = _entry(max(i, j) + p, min(i, j), layout)
            for q in range(3):
                values[at + q] += normal.edge[e, p, q] if i < j else normal.edge[e, q, p]
    for n in range(right.shape[0], SIDE * layout.first.shape[0]):
        values[_entry(n, n, layout)] = 1.0


@compiled
def _write_stems(
    normal: Normal, row: Int, begin: Int, layout: MatrixLayout, damping: float, values: Float, right: Float
) -> Float:
    """Subtract W V^-1 W^T of the eliminated stems from the reduced matrix and W V^-1 g_l from its gradient,
    and write the blocks of the others; return V^-1 of the eliminated ones as xx, xy, yy, shape (L, 3).

    Args:
        normal: Normal equations.
        row: Pose of each detection, int64, shape (M,).
        begin: First detection of each stem, and M, int64, shape (L + 1,).
        layout, damping, values: See `_write_poses`.
        right: Gradient in the order of the unknowns, shape (N,); changed in place.
    """
    place, stem = layout.pose, layout.stem
    inverse = np.zeros((normal.V.shape[0], 3))
    T = np.empty((3, 2))
    for j in range(inverse.shape[0]):
        xx = (1.0 + damping) * normal.V[j, 0] + REGULAR
        yy = (1.0 + damping) * normal.V[j, 2] + REGULAR
        xy = normal.V[j, 1]
        if stem[j] >= 0:
            values[_entry(stem[j], stem[j], layout)] += xx
            values[_entry(stem[j] + 1, stem[j], layout)] += xy
            values[_entry(stem[j] + 1, stem[j] + 1, layout)] += yy
            for q in range(2):
                right[stem[j] + q] = normal.g_l[j, q]
                for m in range(begin[j], begin[j + 1]):
                    at = _entry(stem[j] + q, place[row[m]], layout)
                    for p in range(3):
                        values[at + p] += normal.W[m, p, q]
            continue
        determinant = xx * yy - xy * xy
        inverse[j, 0], inverse[j, 1], inverse[j, 2] = yy / determinant, -xy / determinant, xx / determinant
        for m in range(begin[j], begin[j + 1]):
            column = place[row[m]]
            for p in range(3):
                T[p, 0] = normal.W[m, p, 0] * inverse[j, 0] + normal.W[m, p, 1] * inverse[j, 1]
                T[p, 1] = normal.W[m, p, 0] * inverse[j, 1] + normal.W[m, p, 1] * inverse[j, 2]
                right[column + p] -= T[p, 0] * normal.g_l[j, 0] + T[p, 1] * normal.g_l[j, 1]
            for n in range(begin[j], begin[j + 1]):
                if place[row[n]] < column:
                    continue
                for p in range(3):
                    at = _entry(place[row[n]] + p, column, layout)
                    for q in range(3 if place[row[n]] > column else p + 1):
                        values[at + q] -= normal.W[n, p, 0] * T[q, 0] + normal.W[n, p, 1] * T[q, 1]
    return inverse


@compiled
def _stem_steps(
    normal: Normal, inverse_V: Float, row: Int, begin: Int, layout: MatrixLayout, step: Float
) -> Float:
    """Return the steps of the stems, shape (L, 2) [m]: -V^-1 (g_l + W^T dx) of the eliminated ones.

    Args:
        normal: Normal equations.
        inverse_V, row, begin, layout: See `_write_stems`.
        step: Step of all unknowns of the reduced matrix, shape (N,).
    """
    dl = np.empty((inverse_V.shape[0], 2))
    for j in range(dl.shape[0]):
        at = layout.stem[j]
        if at >= 0:
            dl[j, 0], dl[j, 1] = step[at], step[at + 1]
            continue
        gx, gy = normal.g_l[j, 0], normal.g_l[j, 1]
        for m in range(begin[j], begin[j + 1]):
            for p in range(3):
                dx = step[layout.pose[row[m]] + p]
                gx += normal.W[m, p, 0] * dx
                gy += normal.W[m, p, 1] * dx
        dl[j, 0] = -inverse_V[j, 0] * gx - inverse_V[j, 1] * gy
        dl[j, 1] = -inverse_V[j, 1] * gx - inverse_V[j, 2] * gy
    return dl


def cauchy_weight(d2: Float) -> Float:
    """Return the weights of squared errors [sigma^2] by the Cauchy kernel: 1 for 0, towards 0 for large
    errors; same shape."""
    return 1.0 / (1.0 + d2 / CAUCHY**2)


def _interpolated(rows: Int, matrices: Float, count: int) -> Float:
    """Return matrices for the rows 0 to `count` - 1, shape (count, 3, 3), interpolated linearly between those
    of some rows, shape (N, 3, 3), and constant before and after them."""
    flat, at = matrices.reshape(-1, 9), np.arange(count)
    return np.column_stack([np.interp(at, rows, column) for column in flat.T]).reshape(-1, 3, 3)


def _root_information(covariance: Float) -> Float:
    """Return upper triangular matrices W with W^T W = covariance^-1, shape (N, n, n), for covariances of this
    shape.

    Raises:
        LinAlgError: A covariance is not positive definite.
    """
    if not len(covariance):
        return covariance
    return np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)
