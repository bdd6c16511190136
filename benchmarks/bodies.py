"""Rigid bodies: the time to an error, beside MuJoCo and Diffrax.

`free`: an asymmetric body without forces, over six periods of its momentum. The
reference is Jacobi's solution (Landau and Lifshitz, paragraph 37), with the angle of
precession by quadrature.

`top`: a heavy top with friction, about a fast spin. The reference is SciPy's DOP853.

`rods`: rods that hang by ball joints, with viscous drag on the velocity of each centre
and on each angular velocity: in MuJoCo its `viscosity`, in reduced coordinates; here
constraints that join free bodies. The reference is SciPy's DOP853 on the equations in
reduced coordinates, the same that Diffrax solves, and it is compared with MuJoCo's RK4.
`--rods 5` measures another number.

Errors are of positions of the centres and of rotation matrices at the end. Steps are
constant, but for those of Diffrax that are adaptive. MuJoCo loads a model once; a time
is that of its steps. A dash is an error that no run reached, or a program that is not
installed.
"""

import importlib
import itertools
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.special
from _report import command_line, Table
from _solve import integrated, relative_error, states
from _timing import diffrax_runs, error_curves, print_least
from scipy.spatial.transform import Rotation

import diffrax_presym as dps


TARGETS = 1e-3, 1e-6, 1e-9
STRANG = dps.Strang()
SCHEMES = {
    "Strang": STRANG,
    "Suzuki4(Strang)": dps.Suzuki4(STRANG),
    "SofroniouSpaletta(6, Strang)": dps.SofroniouSpaletta(6, STRANG),
    "SofroniouSpaletta(8, Strang)": dps.SofroniouSpaletta(8, STRANG),
    "BlanesMoan6": dps.BlanesMoan6(),
}
# Of bodies that nothing joins.
NYSTROM = {"BlanesMoanRKN6": dps.BlanesMoanRKN6(), "TunedRKN6": dps.TunedRKN6()}
INTEGRATORS = "Euler", "implicitfast", "RK4"
OURS, THEIRS, MUJOCO = "diffrax_presym", "Diffrax", "MuJoCo"


def simulation(text, qpos, qvel, t1):
    """A function of the integrator and the number of steps; `None` without MuJoCo."""
    try:
        mj: Any = importlib.import_module("mujoco")
    except ImportError:
        print("MuJoCo is not installed.")
        return None
    # Steps that are too long would be warned of, in a file too.
    mj.set_mju_user_warning(lambda message: None)
    model = mj.MjModel.from_xml_string(text)
    data = mj.MjData(model)

    def simulate(integrator, steps):
        model.opt.integrator = getattr(mj.mjtIntegrator, f"mjINT_{integrator.upper()}")
        model.opt.timestep = t1 / steps
        mj.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mj.mj_step(model, data, nstep=int(steps))
        mj.mj_kinematics(model, data)
        return data.xipos[1:].copy(), data.ximat[1:].reshape(-1, 3, 3).copy()

    return simulate


def inertial(inertia, below=0.0):
    """The XML of a body of mass one, whose centre is below its joint."""
    moments = " ".join(map(repr, map(float, inertia)))
    return f'<inertial pos="0 0 {-below}" mass="1" diaginertia="{moments}"/>'


def compare(
    caption, ours, theirs, simulate, exact, least, quick, schemes=SCHEMES | NYSTROM
):
    """Tables of the time to an error: of our schemes and of Diffrax's, functions of the
    scheme and of more options that return a solve, and of MuJoCo."""
    counts = list(map(float, np.ceil(least * 2 ** (np.arange(40) / 2))))
    tolerances = list(10.0 ** -np.arange(3, 14))
    runs = {}
    for name in list(schemes)[1:2] if quick else schemes:
        runs[OURS, name] = ours(schemes[name]), counts
    runs |= diffrax_runs(theirs, THEIRS, counts, tolerances, quick)
    for name in INTEGRATORS if simulate else ():
        runs[MUJOCO, name] = partial(simulate, name), [10 * x for x in counts]
    error = lambda y: relative_error(y, exact)
    enough = (min(TARGETS), 0.1 if quick else 2.0)
    curves = error_curves(runs, error, 2 if quick else 5, enough)
    print_least(caption, curves, TARGETS, OURS)


def turns(times, y0, term, solver, **more):
    """A solve of one body until its end, of which the centre is at rest."""
    end = lambda x: states(term, solver, times, y0, x, **more)
    place = jnp.zeros((1, 3))
    return jax.jit(lambda x: (place, dps.rotation_matrix(end(x)[0])[None]))


# A free body.

MOMENTS, SPIN = np.array([1.0, 1.5, 2.2]), np.array([1.0, 0.0, 1.5])


def jacobi(t1):
    """The rotation matrix of the body, at first the identity, and its angular momentum,
    at first `SPIN`, for which it turns about the third axis."""
    a, b, c = MOMENTS
    energy, square = np.sum(SPIN**2 / MOMENTS), np.sum(SPIN**2)
    omega = np.sqrt((c - b) * (square - energy * a) / (a * b * c))
    m = (b - a) * (energy * c - square) / ((c - b) * (square - energy * a))
    sizes = [a * (energy * c - square) / (c - a), b * (energy * c - square) / (c - b)]
    sizes = np.sqrt([*sizes, c * (square - energy * a) / (c - a)])

    def momentum(t):
        sn, cn, dn, _ = scipy.special.ellipj(omega * t, m)
        return sizes * np.stack([cn, sn, dn], axis=-1)

    def precession(t):
        p = momentum(t)
        across = p[..., 0] ** 2 + p[..., 1] ** 2
        return np.sqrt(square) * (p[..., 0] ** 2 / a + p[..., 1] ** 2 / b) / across

    def in_space(p, angle):
        """The attitude where the third axis of space is along the momentum."""
        tilt, turn = np.arccos(p[2] / np.sqrt(square)), np.arctan2(p[0], p[1])
        return Rotation.from_euler("ZXZ", [angle, tilt, turn]).as_matrix()

    panels = np.linspace(0.0, t1, 1 + int(np.ceil(t1 / 0.5)))
    parts = itertools.pairwise(panels)
    angle = sum(scipy.integrate.fixed_quad(precession, *x, n=20)[0] for x in parts)
    first, p = in_space(momentum(0.0), 0.0), momentum(t1)
    return first.T @ in_space(p, angle), p


def free(options, t1=100.0):
    times, unit = (0.0, t1), np.array([1.0, 0.0, 0.0, 0.0])
    none = lambda t, q, args: jnp.zeros(())
    system = dps.ManifoldSystem(dps.Attitude(MOMENTS), none)
    y0, moments = (jnp.array(unit), jnp.array(SPIN)), jnp.array(MOMENTS)

    def rates(t, y, args):
        q, p = y
        return turning(q, p / moments), jnp.cross(p, p / moments)

    run = partial(turns, times, y0)
    matrix, p = jacobi(t1)
    q_end, p_end = integrated(rates, y0, t1)
    table = Table(
        "Jacobi's solution: difference from DOP853, change of the momentum in space",
        *("attitude:>9.1e", "momentum:>9.1e", "change:>9.1e"),
    )
    apart = relative_error(dps.rotation_matrix(q_end), matrix), relative_error(p_end, p)
    table.row(*apart, relative_error(matrix @ p, SPIN))
    body = f"<body><freejoint/>{inertial(MOMENTS)}</body>"
    option = '<option gravity="0 0 0"><flag contact="disable"/></option>'
    text = f"<mujoco>{option}<worldbody>{body}</worldbody></mujoco>"
    still = np.zeros(3)
    start = [*still, *unit], [*still, *(SPIN / MOMENTS)]
    compare(
        f"A free body to t = {t1}",
        *(partial(run, system), partial(run, dfx.ODETerm(rates))),
        *(simulation(text, *start, t1), (np.zeros((1, 3)), matrix[None])),
        *(50, options.quick),
    )


def top(options, t1=100.0):
    moments, weight, rate = jnp.array([1.0, 1.2, 0.4]), 3.0, 0.01
    height = lambda t, q, args: weight * dps.rotation_matrix(q)[2, 2]
    law = dps.ConstantDamping(rate)
    system = dps.ManifoldSystem(dps.Attitude(moments), height, law)
    tilted = jnp.array([np.cos(0.3), np.sin(0.3), 0.0, 0.0])
    y0 = tilted, moments * jnp.array([0.1, 0.2, 10.0])

    def rates(t, y, args):
        q, p = y
        torque = weight * jnp.cross(dps.rotation_matrix(q)[2], jnp.eye(3)[2])
        return turning(q, p / moments), jnp.cross(p, p / moments) + torque - rate * p

    run = partial(turns, (0.0, t1), y0)
    matrix = dps.rotation_matrix(integrated(rates, y0, t1)[0])
    compare(
        f"A heavy top with friction to t = {t1}",
        *(partial(run, system), partial(run, dfx.ODETerm(rates)), None),
        *((np.zeros((1, 3)), matrix[None]), 200, options.quick),
    )


def turning(q, omega):
    """The rate of change of quaternions, by angular velocities along axes of bodies."""
    w, u = q[..., :1], q[..., 1:]
    real = -jnp.sum(u * omega, axis=-1, keepdims=True)
    return jnp.concatenate([real, w * omega + jnp.cross(u, omega)], axis=-1) / 2


# Rods that are joined, of mass one and length one.

GRAVITY, HALF, VISCOSITY = 9.81, 0.5, 0.02
INERTIA = np.array([0.09, 0.08, 0.02])


def drag():
    """The coefficients of MuJoCo: those of a sphere with the mean of the half axes of
    the box that has this inertia."""
    radius = np.mean(np.sqrt(1.5 * (np.sum(INERTIA) - 2 * INERTIA)))
    return 6 * np.pi * VISCOSITY * radius, 8 * np.pi * VISCOSITY * radius**3


def arms(q):
    """From the upper ends to the centres."""
    return -HALF * dps.rotation_matrix(q)[..., 2]


def joints(t, q, args):
    upper, lower = q[0] - arms(q[1]), q[0] + arms(q[1])
    return upper - jnp.concatenate([jnp.zeros((1, 3)), lower[:-1]])


def joined(n):
    force, torque = drag()
    masses: Any = jnp.ones((n, 1))
    rods = dps.Euclidean(masses), dps.Attitude(np.tile(INERTIA, (n, 1)))
    weight = lambda t, q, args: GRAVITY * jnp.sum(q[0][:, 2])
    law = dps.ViscousDamping((force, torque))
    return dps.ConstrainedSystem(dps.ManifoldSystem(rods, weight, law), joints)


def reach(n):
    """How far each centre moves with each arm."""
    return 2 * np.tril(np.ones((n, n))) - np.eye(n)


def reduced(t, y, args):
    """The rates of change of attitudes and of angular velocities, along axes of bodies:
    the sums of the torques about the joints vanish (d'Alembert)."""
    (q, omega), n = y, len(y[0])
    force, torque = drag()
    R, c, inertia = dps.rotation_matrix(q), arms(q), jnp.array(INERTIA)
    rotate = lambda x: jnp.einsum("kij,kj->ki", R, x)
    w, far = rotate(omega), reach(n)
    known = far @ jnp.cross(w, jnp.cross(w, c)) + force * far @ jnp.cross(w, c)
    known += jnp.array([0.0, 0.0, GRAVITY])
    torques = rotate(jnp.cross(omega, inertia * omega) + torque * omega)
    torques += jnp.cross(c, far.T @ known)
    eye = jnp.eye(3)
    outer = c[:, None, None] * c[None, :, :, None]  # of j, along the first axis
    inner = jnp.sum(c[:, None] * c[None], axis=-1)[..., None, None] * eye
    blocks = (far.T @ far)[..., None, None] * (inner - outer)
    each = jnp.einsum("kij,j,klj->kil", R, inertia, R)
    blocks += jnp.eye(n)[..., None, None] * each[:, None]
    matrix = jnp.transpose(blocks, (0, 2, 1, 3)).reshape(3 * n, 3 * n)
    gained = -jnp.linalg.solve(matrix, torques.ravel()).reshape(n, 3)
    # The same along the axes of the bodies, as these turn with the angular velocity.
    return turning(q, omega), jnp.einsum("kij,ki->kj", R, gained)


def placed(q):
    """The centres and the matrices, from the attitudes."""
    return reach(len(q)) @ arms(q), dps.rotation_matrix(q)


def check(simulate, exact, quick):
    """RK4 of MuJoCo, at three numbers of steps, and what they extrapolate to."""
    steps = 2000 if quick else 16000
    ends = [
        np.concatenate([*map(np.ravel, simulate("RK4", n * steps))]) for n in (1, 2, 4)
    ]
    change = [np.max(np.abs(b - a)) for a, b in itertools.pairwise(ends)]
    power = change[0] / change[1]
    best = ends[2] + (ends[2] - ends[1]) / (round(power) - 1)
    table = Table(
        "MuJoCo's RK4 and the reference",
        *("steps:>7", "difference:>10.1e", "order:>5.2f", "extrapolated:>12.1e"),
    )
    last = relative_error(ends[2], exact), np.log2(power), relative_error(best, exact)
    table.row(str(4 * steps), *last)


def rods(options, t1=2.0):
    n, times, quick = options.rods, (0.0, t1), options.quick
    rng = np.random.default_rng(0)
    attitudes = Rotation.from_euler("xyz", rng.uniform(-1, 1, (n, 3)))
    omega = rng.uniform(-1, 1, (n, 3)) * np.array([1.0, 1.0, 5.0])
    q = attitudes.as_quat(scalar_first=True)
    R, c = attitudes.as_matrix(), np.asarray(arms(q))
    v = reach(n) @ np.cross(np.einsum("kij,kj->ki", R, omega), c)
    system, term = joined(n), dfx.ODETerm(reduced)
    y0 = {
        "bodies": ((placed(q)[0], q), (v, INERTIA * omega)),
        "reduced": (q, omega),
    }
    y0 = jax.tree.map(jnp.asarray, y0)

    def ours(solver):
        end = lambda x: states(system, solver, times, y0["bodies"], x)[0]
        return jax.jit(lambda x: (lambda q: (q[0], dps.rotation_matrix(q[1])))(end(x)))

    def theirs(solver, **more):
        end = lambda x: states(term, solver, times, y0["reduced"], x, **more)[0]
        return jax.jit(lambda x: placed(end(x)))

    # In MuJoCo relative to the rod above.
    relative = [
        attitudes[0],
        *(attitudes[k - 1].inv() * attitudes[k] for k in range(1, n)),
    ]
    above = [R[k].T @ R[k - 1] @ omega[k - 1] for k in range(1, n)]
    start = (
        np.ravel([x.as_quat(scalar_first=True) for x in relative]),
        np.ravel([omega[0], *(omega[k] - above[k - 1] for k in range(1, n))]),
    )
    text = (
        f'<mujoco><option gravity="0 0 {-GRAVITY}" density="0" viscosity="{VISCOSITY}">'
        '<flag contact="disable"/></option><worldbody>'
    )
    for k in range(n):
        text += f'<body pos="0 0 {-2 * HALF if k else 0}"><joint type="ball"/>'
        text += inertial(INERTIA, HALF)
    text += "</body>" * n + "</worldbody></mujoco>"
    simulate, exact = (
        simulation(text, *start, t1),
        placed(integrated(reduced, y0["reduced"], t1)[0]),
    )
    if simulate:
        check(simulate, exact, quick)
    caption = f"{n} rods with ball joints and drag to t = {t1}"
    compare(caption, ours, theirs, simulate, exact, 20, quick, SCHEMES)


def main():
    parser = command_line(__doc__)
    parts = {"free": free, "top": top, "rods": rods}
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(parts)}")
    parser.add_argument("--rods", type=int, default=3, help="how many")
    options = parser.parse_args()
    for name in options.parts or parts:
        parts[name](options)
        jax.clear_caches()


if __name__ == "__main__":
    main()
