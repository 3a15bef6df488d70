"""Membrane maps by stress resultants: the same discrete equations as `operators`, in half the unknowns. X: (M, 2, n).

The force density on the membrane is the derivative of a resultant, f = q_s. With q = Lambda t + Q n, node by node, D the derivative
in alpha (skew: D^T = -D), h = 2 pi/n, v the speed and K the symmetric kernel of the single layer,

    u = h K D q        D u = -h G q,    G = D^T K D:  symmetric, with blocks G_tt, G_tn, G_nn in the frame (t, n)

    inextensible    t.D u = 0                                       tension against an outer velocity u:  sigma = G_tt^-1 t.D u / h
    bending         q_b = -kappa_b X_sss
    semi-implicit   Z = dt u, where t.Z_s = 0 and so Z_s = theta n exactly:   v theta = -dt h Sigma Q,   Sigma = G_nn - G_nt G_tt^-1 G_tn
                    Q = n.q_b - kappa_b n.(theta n)_ss              one n x n system for Q;   Lambda = -G_tt^-1 G_tn Q

so systems of 2n unknowns become ones of n, and P T, P B never appear. G costs two products with one constant matrix. Geometry and
resultants of X are float64; K, G and the solves may be float32. Matrices are made chunk by chunk, on threads, and not kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import pi

from biem.backend import Array, array_namespace, compiled, constant, count, from_numpy, on_cpu, parallel_map, shares, solve, to_numpy
from biem.curves.curve import center_of_nodes, d_ds, dot
from biem.curves.fourier import derivative, differentiation_matrix
from biem.stokes.kress import apply_single_layer, single_layer_kernel

CPU_CHUNK, DEVICE_CHUNK = 1 << 17, 1 << 25  # entries of one n x n matrix over all vesicles in work: to fit the cache, the memory


@dataclass(frozen=True)
class Resultants:
    """The maps of the curves X (M, 2, n), each part built when first asked for. dtype: of K, G and the solves (default that of X)."""

    X: Array
    kappa_b: float = 1.0
    mu: float = 1.0
    dtype: object = None

    @cached_property
    def h(self) -> float:
        return 2.0 * pi / self.X.shape[-1]

    @cached_property
    def local(self) -> Array:
        """X about the mean node."""
        return self.X - center_of_nodes(self.X)

    @cached_property
    def X_alpha(self) -> Array:
        return derivative(self.local)

    @cached_property
    def speed(self) -> Array:
        return array_namespace(self.X).sqrt(dot(self.X_alpha, self.X_alpha))

    @cached_property
    def t(self) -> Array:
        return self.X_alpha / self.speed[:, None, :]

    @cached_property
    def n(self) -> Array:
        return array_namespace(self.X).stack([self.t[:, 1], -self.t[:, 0]], axis=1)

    @cached_property
    def bending(self) -> Array:
        """q_b = -kappa_b X_sss (M, 2, n)."""
        return -self.kappa_b * d_ds(d_ds(self.t, self.speed), self.speed)

    @cached_property
    def W(self) -> Array:
        """(M, n, n) with W^T W = G_tt^-1; the condition number of G_tt is about 0.75 n."""
        count("tension_matrix", self.X.shape[0])
        return self._by_chunk(lambda part: part.strain_matrices(part.kernel())[1])

    def velocity(self, q: Array) -> Array:
        """u (M, 2, n) of the resultant q (M, 2, n)."""
        g = self.h * derivative(q)
        return self._by_chunk(lambda part, g: apply_single_layer(part.local, part.X_alpha, g, self.mu), g)

    def flow_tension(self, u: Array) -> Array:
        """L^-1 P u (M, n): minus the tension that makes the velocity u (M, 2, n) inextensible."""
        return self.tensions(self.rate(u)[..., None], self.W)[..., 0]

    def rate(self, u: Array) -> Array:
        """t . u_alpha (M, n), what the velocity u stretches by, times the speed."""
        return dot(self.t, derivative(u))

    def tensions(self, rates: Array, W: Array) -> Array:
        """L^-1 P u (M, n, C) of C velocities by their rates (M, n, C)."""
        xp = array_namespace(self.X)
        return self._exact(xp.matmul(_transpose(W), xp.matmul(W, self._working(rates / -self.h))))

    def self_tension(self) -> Array:
        """L^-1 P B X (M, n)."""
        return self.flow_tension(self.velocity(self.bending))

    def project(self, u: Array) -> Array:
        """(1 - M) u (M, 2, n)."""
        return u - self.velocity(self.flow_tension(u)[:, None, :] * self.t)

    def relaxation(self, dt: float) -> Array:
        """Z (M, 2, n) with Z/dt = (1 - M) B (X + Z), arclength frozen at X."""
        count("relaxation_matrix", self.X.shape[0])
        q = self._by_chunk(lambda part: part.relaxed_resultant(dt, *part.strain_matrices(part.kernel())))
        return dt * self.velocity(q)

    def relaxed_resultant(self, dt: float, G: Array, W: Array) -> Array:
        """Lambda t + Q n of X + Z (M, 2, n), from the `strain_matrices`."""
        xp = array_namespace(self.X)
        t, n = self._working(self.t), self._working(self.n)
        Y = xp.matmul(W, in_frame(G, t, n))
        Sigma = in_frame(G, n, n) - xp.matmul(_transpose(Y), Y)
        D = constant(differentiation_matrix, self.X.shape[-1], like=Sigma)
        inverse_speed = self._working(1.0 / self.speed)
        D2 = xp.matmul(D, inverse_speed[:, :, None] * D)
        D2_n = dot_product_matrix(D2, inverse_speed[:, None, :] * n, (-dt * self.h * self.kappa_b) * inverse_speed[:, None, :] * n)
        A = xp.eye(D2.shape[-1], dtype=D2.dtype, device=D2.device) + xp.matmul(D2_n, Sigma)
        Q = solve(A, self._working(dot(self.n, self.bending))[..., None])[..., 0]
        Lambda = -_matvec(_transpose(W), _matvec(Y, Q))
        return self._exact(Lambda)[:, None, :] * self.t + self._exact(Q)[:, None, :] * self.n

    def kernel(self) -> Array:
        """Blocks xx, xy, yy of K (M, 3, n, n), of all vesicles at once: for callers who take few."""
        return self._working(single_layer_kernel(self.local, self.X_alpha, self.mu))

    def strain_matrices(self, K: Array) -> tuple[Array, Array]:
        """Blocks xx, xy, yy of G = D^T K D (M, 3, n, n), and W."""
        xp = array_namespace(K)
        D = constant(differentiation_matrix, K.shape[-1], like=K)
        G = xp.matmul(-D, xp.matmul(K, D))
        t = self._working(self.t)
        return G, inverse_factor(in_frame(G, t, t))

    def _by_chunk(self, function: Callable[..., Array], *fields: Array) -> Array:
        """function(part, *fields of the part) over chunks of vesicles, joined."""
        M, _, n = self.X.shape
        on_host = on_cpu(self.X)
        _ = self.bending  # the geometry is made for all vesicles at once
        most = max(1, (CPU_CHUNK if on_host else DEVICE_CHUNK) // n**2)
        chunks = shares(0, M, 1, most) if on_host else [slice(i, i + most) for i in range(0, M, most)]
        work = [(self._part(chunk), *(f[chunk] for f in fields)) for chunk in chunks]
        parts = parallel_map(lambda args: function(*args), work) if on_host else [function(*args) for args in work]
        return parts[0] if len(parts) == 1 else array_namespace(self.X).concat(parts, axis=0)

    def _part(self, which: slice) -> Resultants:
        if which.stop - which.start >= self.X.shape[0]:
            return self
        part = Resultants(self.X[which], self.kappa_b, self.mu, self.dtype)
        part.__dict__.update({name: value[which] for name, value in self.__dict__.items() if name in GEOMETRY})
        return part

    def _working(self, a: Array) -> Array:
        return a if self.dtype is None else array_namespace(a).astype(a, self.dtype, copy=False)

    def _exact(self, a: Array) -> Array:
        return array_namespace(a).astype(a, self.X.dtype, copy=False)


GEOMETRY = ("local", "X_alpha", "speed", "t", "n", "bending")


def in_frame(G: Array, a: Array, b: Array) -> Array:
    """a . G b (M, n, n) for blocks xx, xy, yy G (M, 3, n, n) and fields a, b (M, 2, n) of one dtype."""
    if on_cpu(G):
        return _compiled(G, "in_frame", G, a, b)
    a, b = a[..., :, None], b[..., None, :]
    return a[:, 0] * (G[:, 0] * b[:, 0] + G[:, 1] * b[:, 1]) + a[:, 1] * (G[:, 1] * b[:, 0] + G[:, 2] * b[:, 1])


def inverse_factor(A: Array) -> Array:
    """W (M, n, n) with W^T W = A^-1 for symmetric positive definite A (M, n, n); not finite where A is not.

    A direction that A annihilates to rounding is left out, as the constant tension of a circle, which exerts no force.
    """
    xp = array_namespace(A)
    least = 4.0 * A.shape[-1] * float(xp.finfo(A.dtype).eps)
    if on_cpu(A):
        return _compiled(A, "inverse_factor", A, least)
    identity = xp.broadcast_to(xp.eye(A.shape[-1], dtype=A.dtype, device=A.device), A.shape)
    shift = least * xp.max(xp.linalg.diagonal(A), axis=-1)
    factor, _ = xp.linalg.cholesky_ex(A + shift[:, None, None] * identity)  # torch: without the check that waits for the device
    return xp.linalg.solve_triangular(factor, identity, upper=False)


def dot_product_matrix(A: Array, a: Array, b: Array) -> Array:
    """A_ij (a_i . b_j) (M, n, n) for A (M, n, n) and fields a, b (M, 2, n) of one dtype."""
    if on_cpu(A):
        return _compiled(A, "dot_product_matrix", A, a, b)
    a, b = a[..., :, None], b[..., None, :]
    return A * (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])


def _compiled(like: Array, name: str, *arguments: Array) -> Array:
    arguments = tuple(a if isinstance(a, float) else to_numpy(a) for a in arguments)
    return from_numpy(getattr(compiled("biem.membrane.resultants_loop"), name)(*arguments), like)


def _matvec(A: Array, x: Array) -> Array:
    return array_namespace(A).matmul(A, x[..., None])[..., 0]


def _transpose(A: Array) -> Array:
    return array_namespace(A).permute_dims(A, (0, 2, 1))
