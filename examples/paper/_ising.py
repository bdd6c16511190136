"""The two-dimensional periodic Ising model: exact, and by Monte Carlo."""

import jax
import jax.numpy as jnp
import tqdm


CRITICAL_TEMPERATURE = float(2 / jnp.log(1 + jnp.sqrt(2)))


def log_partition(beta, size):
    """The logarithm of the partition function of `size` x `size` spins.

    B. Kaufman (1949), Physical Review 76, 1232.
    """

    def gamma(number):
        angle = jnp.pi * number / size
        return jnp.arccosh(jnp.cosh(2 * beta) / jnp.tanh(2 * beta) - jnp.cos(angle))

    # The first of the even terms changes its sign at the critical temperature.
    first = 2 * beta + jnp.log(jnp.tanh(beta))
    odd = gamma(jnp.arange(1, 2 * size, 2)) * size / 2
    even = jnp.append(gamma(jnp.arange(2, 2 * size, 2)), first) * size / 2
    products = [jnp.prod(2 * fn(x)) for fn in (jnp.cosh, jnp.sinh) for x in (odd, even)]
    return size**2 / 2 * jnp.log(2 * jnp.sinh(2 * beta)) + jnp.log(sum(products) / 2)


def exact(temperature, size):
    """Energy and heat capacity per spin, equation (observables)."""
    beta = 1 / temperature
    slope = jax.grad(log_partition)
    energy = -slope(beta, size)
    heat_capacity = beta**2 * jax.grad(slope)(beta, size)
    return energy / size**2, heat_capacity / size**2


def energy(spins):
    """The energy of each lattice; the lattices are the last two axes of the array."""
    spins = spins.astype(jnp.float32)
    neighbours = jnp.roll(spins, 1, axis=-1) + jnp.roll(spins, 1, axis=-2)
    return -jnp.sum(spins * neighbours, axis=(-1, -2))


def estimates(energies, temperature, size):
    """Energy and heat capacity per spin from a sample of energies."""
    heat_capacity = jnp.var(energies) / temperature**2
    return jnp.mean(energies) / size**2, heat_capacity / size**2


def sweep(key, spins, temperature):
    """One Metropolis sweep, on a checkerboard: first the black spins, then the white.

    Neighbours have different colours, so all spins of one colour are updated at once.
    """
    uniform = jax.random.uniform(key, spins.shape, spins.dtype)
    black = jnp.indices(spins.shape[-2:]).sum(axis=0) % 2 == 0
    for colour in (black, ~black):
        around = sum(jnp.roll(spins, n, axis=a) for n in (1, -1) for a in (-1, -2))
        accepted = uniform < jnp.exp(-2 * spins * around / temperature)
        spins = jnp.where(colour & accepted, -spins, spins)
    return spins


@jax.jit(static_argnames="sweeps")
def run(key, spins, temperatures, sweeps):
    """Apply `sweeps` sweeps to lattices of shape (temperature, chain, size, size)."""
    temperatures = temperatures.astype(spins.dtype)[:, None, None, None]
    body = lambda i, s: sweep(jax.random.fold_in(key, i), s, temperatures)
    return jax.lax.fori_loop(0, sweeps, body, spins)


def metropolis(key, temperatures, size, chains, samples, burn_in=512, thin=10):
    """Samples at each temperature, of shape (temperature, sample, size, size).

    Half of the chains start with all spins up, half with all down: at low temperatures
    the magnetisation rarely changes sign, and random lattices freeze into stripes.
    """
    up = jnp.where(jnp.arange(chains) % 2 == 0, 1.0, -1.0).astype(jnp.float32)
    shape = (len(temperatures), chains, size, size)
    spins = jnp.broadcast_to(up[:, None, None], shape)
    spins = run(key, spins, temperatures, burn_in)
    drawn = []
    for i in tqdm.trange(samples, desc="Metropolis"):
        spins = run(jax.random.fold_in(key, i + 1), spins, temperatures, thin)
        drawn.append(spins.astype(jnp.int8))
    return jnp.concatenate(drawn, axis=1)
