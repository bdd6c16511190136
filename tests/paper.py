"""The schemes as printed in the paper: plain NumPy, canonical momentum `P`.

`H.velocity(t, q, P)` and `H.slope(t, q, P)` are the derivatives of `H(t, q, P)` with
respect to `P` and `q`. Implicit equations are solved by fixed-point iteration, which
for a separable system is exact after one iteration.
"""

from collections.abc import Callable

import numpy as np


def fixed_point(fn, x, iterations=60):
    for _ in range(iterations):
        x = fn(x)
    return x


def euler_A(H, t, h, q, P):
    """Equation (presymp_euler)."""
    P = fixed_point(lambda P_new: P - h * H.slope(t, q, P_new), P)
    return q + h * H.velocity(t, q, P), P


def euler_B(H, t, h, q, P):
    """Equation (presymp_euler2)."""
    q = fixed_point(lambda q_new: q + h * H.velocity(t + h, q_new, P), q)
    return q, P - h * H.slope(t + h, q, P)


def leapfrog_AB(H, t, h, q, P):
    """Equation (presymp_leapfrog)."""
    half = h / 2
    P_mid = fixed_point(lambda P_new: P - half * H.slope(t, q, P_new), P)
    start = H.velocity(t, q, P_mid)
    q = fixed_point(
        lambda q_new: q + half * (start + H.velocity(t + h, q_new, P_mid)), q
    )
    return q, P_mid - half * H.slope(t + h, q, P_mid)


def leapfrog_BA(H, t, h, q, P):
    """Equation (presymp_leapfrog2)."""
    half = h / 2
    middle = t + half
    q_mid = fixed_point(lambda q_new: q + half * H.velocity(middle, q_new, P), q)
    start = H.slope(middle, q_mid, P)
    P = fixed_point(lambda P_new: P - half * (start + H.slope(middle, q_mid, P_new)), P)
    return q_mid + half * H.velocity(middle, q_mid, P), P


def triple_jump(base, order):
    """Equation (yoshida_comp), from a base scheme of lower order."""

    def scheme(H, t, h, *y):
        kappa = 2 ** (1 / (order - 1))
        for tau in (1 / (2 - kappa), -kappa / (2 - kappa), 1 / (2 - kappa)):
            y = base(H, t, tau * h, *y)
            t = t + tau * h
        return y

    return scheme


def tao(coupling):
    """Equations (tao_map1) to (tao_flow), for `(q, P)` and its copy.

    The coupling acts on `exp(-eta) P`, unlike that of the paper: without this scaling,
    the copies separate once `exp(eta)` is large.
    """

    def A(H, t, t_copy, h, q, P, q_copy, P_copy):
        velocity, slope = H.velocity(t, q, P_copy), H.slope(t, q, P_copy)
        return t, t_copy + h, q, P - h * slope, q_copy + h * velocity, P_copy

    def B(H, t, t_copy, h, q, P, q_copy, P_copy):
        velocity, slope = H.velocity(t_copy, q_copy, P), H.slope(t_copy, q_copy, P)
        return t + h, t_copy, q + h * velocity, P, q_copy, P_copy - h * slope

    def C(H, t, t_copy, h, q, P, q_copy, P_copy):
        angle = 2 * coupling(h) * h
        scale = np.exp(H.eta(t))
        cos, sin = np.cos(angle), np.sin(angle)
        p, p_copy = P / scale, P_copy / scale
        q_sum, q_diff, p_sum, p_diff = q + q_copy, q - q_copy, p + p_copy, p - p_copy
        q_diff, p_diff = cos * q_diff + sin * p_diff, cos * p_diff - sin * q_diff
        q, P = (q_sum + q_diff) / 2, scale * (p_sum + p_diff) / 2
        q_copy, P_copy = (q_sum - q_diff) / 2, scale * (p_sum - p_diff) / 2
        return t, t_copy, q, P, q_copy, P_copy

    def scheme(H, t, h, *y):
        t_copy = t
        for flow, part in ((A, h / 2), (B, h / 2), (C, h), (B, h / 2), (A, h / 2)):
            t, t_copy, *y = flow(H, t, t_copy, part, *y)
        return tuple(y)

    return scheme


# By the names of the catalogue.
SCHEMES: dict[str, Callable[..., tuple]] = {
    "Euler": euler_A,
    "Euler, position first": euler_B,
    "leapfrog": leapfrog_AB,
    "leapfrog, position first": leapfrog_BA,
    "Suzuki-Yoshida 4": triple_jump(leapfrog_AB, 4),
    "Tao": tao(lambda h: 3 * np.pi / 16 / abs(h)),
    "Tao 4": triple_jump(tao(lambda h: 4.0), 4),
}
