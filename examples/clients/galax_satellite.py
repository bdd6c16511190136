"""A satellite galaxy sinks by dynamical friction, and is followed back, with galax.

Needs `pip install galax galpy matplotlib` (Python 3.12). Prints the radius at the start
and at the end, the distance from the start after the way back, and the derivative of
the final radius by the mass. Orbit and derivative are compared with SciPy's DOP853 on
the same equation in NumPy, and the orbit also with galpy's own friction. `--figure`
draws the radius, in docs/img.

    python examples/clients/galax_satellite.py [--figure]
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false

import os


os.environ["JAX_ENABLE_X64"] = "true"  # before galax makes its constants

import pathlib
import sys

import diffrax as dfx
import galax.potential as gp
import galpy.df.jeans
import galpy.orbit
import galpy.potential
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.integrate
import scipy.special
from jax.scipy.special import erf

import diffrax_presym as dps


galaxy = gp.MilkyWayPotential()  # kpc, Myr, solar masses
halo, G = galaxy.halo, galaxy.constants["G"].value
scale = halo.r_s(0.0, ustrip="kpc")
fastest = 0.465 * jnp.sqrt(G * halo.m(0.0, ustrip="Msun") / scale)  # circular velocity


def friction(t, q, v, mass):
    r, speed = jnp.linalg.norm(q), jnp.linalg.norm(v)
    x = r / scale  # for the dispersion of the halo, Zentner and Bullock (2003)
    X = speed / (2**0.5 * fastest * 1.4393 * x**0.354 / (1 + 1.1756 * x**0.725))
    slower = erf(X) - 2 / np.sqrt(np.pi) * X * jnp.exp(-(X**2))
    coulomb = jnp.log1p((r / 5.0) ** 2) / 2  # for a half-mass radius of 5 kpc
    density = halo._density(q, t)
    return -4 * np.pi * G**2 * mass * density * coulomb * slower * v / speed**3


satellite = dps.MechanicalSystem(
    dps.QuadraticKinetic(), lambda t, q, args: galaxy._potential(q, t), force=friction
)


@jax.jit
def solve(t0, t1, y0):
    return dfx.diffeqsolve(
        *(satellite, dps.BlanesMoan6(), t0, t1, (t1 - t0) / 4000, y0, 1e10),
        saveat=dfx.SaveAt(ts=jnp.linspace(t0, t1, 401)),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    ).ys


start = jnp.array([60.0, 0.0, 20.0]), jnp.array([0.0, 0.14, 0.04])  # kpc, kpc / Myr
q, v = solve(0.0, 5000.0, start)
back, _ = solve(5000.0, 0.0, (q[-1], v[-1]))


@jax.jit
@jax.jacfwd  # forward mode, by one number
def slope(mass):
    end, _ = dfx.diffeqsolve(
        *(satellite, dps.BlanesMoan6(), 0.0, 5000.0, 1.25, start, mass),
        adjoint=dfx.ForwardMode(),
        max_steps=None,
    ).ys
    return jnp.linalg.norm(end[-1])


radius, again = (np.linalg.norm(x, axis=1) for x in (q, back))
away = jnp.linalg.norm(back[-1] - start[0])
print(f"radius {radius[0]:.1f} kpc, after 5 Gyr {radius[-1]:.1f} kpc")
print(f"the way back ends {away:.0e} kpc from the start")
assert away < 1e-10


def runge_kutta(t0, t1, y0):
    return dfx.diffeqsolve(
        *(satellite, dfx.Dopri8(), t0, t1, None, y0, 1e10),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
    ).ys


there = jax.tree.map(lambda x: x[-1], runge_kutta(0.0, 5000.0, start))
home = runge_kutta(5000.0, 0.0, there)[0][-1]
print(f"  that of Dopri8, tolerance 1e-8, {jnp.linalg.norm(home - start[0]):.0e} kpc")


# The same equation in NumPy, with the potential by formulas.
G, DISK, HALO = 4.498502151469553e-12, (6.8e10, 3.0, 0.28), (5.4e11, 15.62)
SPHEROIDS = (5e9, 1.0), (1.71e9, 0.07)
TIMES = np.linspace(0.0, 5000.0, 401)


def dispersion(r):
    m, a = HALO
    x = r / a
    return 0.465 * np.sqrt(G * m / a) * 1.4393 * x**0.354 / (1 + 1.1756 * x**0.725)


def vector_field(t, y, mass):
    q, v = np.split(y, 2)
    r, speed = np.sqrt(q @ q), np.sqrt(v @ v)
    m, a, b = DISK
    height = np.hypot(q[2], b)
    stretched = q * np.array([1.0, 1.0, (a + height) / height])
    force = -G * m * stretched / (q[0] ** 2 + q[1] ** 2 + (a + height) ** 2) ** 1.5
    for m, a in SPHEROIDS:
        force -= G * m * q / (r * (r + a) ** 2)
    m, a = HALO
    force -= G * m * (np.log1p(r / a) - r / (r + a)) * q / r**3
    X = speed / np.sqrt(2) / dispersion(r)
    slower = scipy.special.erf(X) - 2 * X * np.exp(-(X**2)) / np.sqrt(np.pi)
    drag = G**2 * mass * m / (r * (r + a) ** 2) * slower * np.log1p(r**2 / 25) / 2
    return np.concatenate([v, force - drag * v / speed**3])


def dop853(mass, rtol=1e-12):
    y0, fn = np.concatenate(start), lambda t, y: vector_field(t, y, mass)
    return scipy.integrate.solve_ivp(
        fn, (0.0, 5000.0), y0, "DOP853", t_eval=TIMES, rtol=rtol, atol=1e-14
    ).y[:3].T  # fmt: skip


largest = lambda a, b: np.linalg.norm(a - b, axis=1).max()
exact = dop853(1e10)
print(f"largest difference from SciPy {largest(q, exact):.0e} kpc")
print(f"  SciPy's tolerance of 1e-10 changes {largest(dop853(1e10, 1e-10), exact):.0e}")
more, less = (np.linalg.norm(dop853(mass)[-1]) for mass in (1.0001e10, 0.9999e10))
ours, scipys = 1e9 * slope(1e10), 1e9 * (more - less) / 2e6
print(f"kpc per 1e9 solar masses: {ours:.4f}, SciPy {scipys:.4f}")
assert largest(q, exact) < 1e-6
assert abs(ours - scipys) < 1e-2

# galpy, in the same units: its constant of gravity is one, so that masses are `G m`.
parts = [
    galpy.potential.NFWPotential(G * HALO[0], HALO[1]),
    galpy.potential.MiyamotoNagaiPotential(G * DISK[0], *DISK[1:]),
    *(galpy.potential.HernquistPotential(2 * G * m, a) for m, a in SPHEROIDS),
]
drag = galpy.potential.ChandrasekharDynamicalFrictionForce(
    GMs=G * 1e10,
    rhm=5.0,
    dens=parts[0],
    sigmar=dispersion,
    minr=1.0,
    maxr=100.0,
    nr=5001,
)
orbit = galpy.orbit.Orbit([60.0, 0.0, 0.14, 20.0, 0.04, 0.0])
options = dict(method="dop853_c", rtol=1e-12, atol=1e-12)
orbit.integrate(TIMES, sum(parts[1:], parts[0]) + drag, **options)
theirs = np.stack([x(TIMES, use_physical=False) for x in (orbit.x, orbit.y, orbit.z)])
print(f"largest difference from galpy {largest(q, theirs.T):.0e} kpc")
assert largest(q, theirs.T) < 1e-6
radii = np.array([5.0, 10.0, 20.0, 40.0, 60.0])
jeans = np.array([galpy.df.jeans.sigmar(parts[0], r) for r in radii])
print(f"dispersion, from that by Jeans: {abs(dispersion(radii) / jeans - 1).max():.1%}")

if "--figure" in sys.argv:
    free = np.linalg.norm(dop853(0.0), axis=1)
    figure, axis = plt.subplots(figsize=(7, 3.4), layout="constrained")
    gyr = TIMES / 1000
    axis.plot(gyr, free, color="0.75", label="without friction")
    axis.plot(gyr, radius, label="forwards")
    axis.plot(gyr[::-5], again[::5], "o", ms=4, mfc="none", label="backwards")
    axis.set(xlabel="time (Gyr)", ylabel="distance from the centre (kpc)")
    axis.set(xlim=(0, 5), ylim=(0, 85))
    axis.legend(loc="upper right", ncols=3)
    images = pathlib.Path(__file__).parents[2] / "docs" / "img"
    figure.savefig(images / "galax_satellite.png", dpi=110)
