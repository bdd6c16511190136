"""The posterior of a damped pendulum, by samplers through the recommended solve.

Rate of damping and stiffness are estimated from angles measured at 60 times, with
noise. Chains start from rates of damping between 0.01 and 50, evenly in the logarithm.
Means and standard deviations are compared with those of the posterior on a grid, from
solves by `Dopri8` with adaptive steps: a difference is divided by its Monte Carlo
standard error, from means of fifty draws.

Needs BlackJAX or NumPyro, or both: `pip install blackjax numpyro`.
"""

# pyright: reportMissingImports=false, reportOptionalSubscript=false

import importlib.metadata
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _plot import FOLDER, panels, save
from _report import command_line, Table

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

# The recipe of docs/howto/sampling.md starts here.

ts = jnp.linspace(0.2, 12.0, 60)  # s
noise = 0.1  # rad
truth = jnp.array([0.3, 2.0])  # damping in 1/s, stiffness in 1/s^2
# Logarithms: 95% of the prior is between 0.011 and 43 /s, and 0.75 and 5.3 /s^2.
prior_mean, prior_sd = jnp.log(jnp.array([0.7, 2.0])), jnp.array([2.1, 0.5])


def angles(logs):
    gamma, k = jnp.exp(logs)
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(),
        lambda t, q, args: -k * jnp.cos(q),
        friction=dps.ConstantDamping(gamma),
    )
    sol = dfx.diffeqsolve(
        system,
        dps.TunedRKN6(),
        t0=0.0,
        t1=12.0,
        dt0=0.4,
        y0=(jnp.array(1.5), jnp.array(0.0)),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
        throw=False,
    )
    return sol.ys[0], sol.result == dfx.RESULTS.successful


data = angles(jnp.log(truth))[0] + noise * np.random.default_rng(1).normal(size=60)


def log_density(logs):
    prior = -jnp.sum(((logs - prior_mean) / prior_sd) ** 2) / 2
    q, successful = angles(logs)
    likelihood = -jnp.sum((q - data) ** 2) / (2 * noise**2)
    return jnp.where(successful, prior + likelihood, -jnp.inf)


# It ends here; what follows up to `SAMPLERS` are its two samplers.


def by_blackjax(log_density, starts, key, warmup, draws):
    import blackjax

    def chain(start, key):
        tune, sample = jax.random.split(key)
        adaptation = blackjax.window_adaptation(blackjax.nuts, log_density)
        (state, parameters), tuning = adaptation.run(tune, start, num_steps=warmup)
        nuts = blackjax.nuts(log_density, **parameters)

        def step(state, key):
            state, info = nuts.step(key, state)
            return state, (state.position, info.is_divergent)

        found = jax.lax.scan(step, state, jax.random.split(sample, draws))[1]
        return *found, tuning.info.is_divergent

    return jax.jit(jax.vmap(chain))(starts, jax.random.split(key, len(starts)))


def by_numpyro(log_density, starts, key, warmup, draws):
    from numpyro.infer import MCMC, NUTS

    mcmc = MCMC(
        NUTS(potential_fn=lambda logs: -log_density(logs)),
        num_warmup=warmup,
        num_samples=draws,
        num_chains=len(starts),
        chain_method="vectorized",
        progress_bar=False,
    )
    mcmc.run(key, init_params=starts)
    return mcmc.get_samples(group_by_chain=True), mcmc.get_extra_fields()["diverging"]


SAMPLERS = {"blackjax": by_blackjax, "numpyro": by_numpyro}


def exact_density(logs):
    """The log density by an adaptive solver of Diffrax."""
    gamma, k = jnp.exp(logs)
    field = lambda t, y, args: jnp.stack([y[1], -k * jnp.sin(y[0]) - gamma * y[1]])
    q = dfx.diffeqsolve(
        *(dfx.ODETerm(field), dfx.Dopri8(), 0.0, 12.0, 1e-3, jnp.array([1.5, 0.0])),
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-9),
        max_steps=None,
    ).ys[:, 0]
    prior = jnp.sum(((logs - prior_mean) / prior_sd) ** 2) / 2
    return -prior - jnp.sum((q - data) ** 2) / (2 * noise**2)


def on_grid(center, width, n):
    """A grid of logarithms, and the probabilities of its points."""
    axes = [jnp.linspace(c - w, c + w, n) for c, w in zip(center, width, strict=True)]
    grid = jnp.stack(jnp.meshgrid(*axes, indexing="ij"), -1)
    density = jax.jit(lambda x: jax.lax.map(jax.vmap(exact_density), x))(grid)
    weight = jnp.exp(density - density.max())
    return grid, weight / weight.sum()


def moments(values, weight):
    """Mean and standard deviation over all axes but the last."""
    average = lambda x: jnp.sum(x * weight[..., None], (0, 1))
    mean = average(values)
    return mean, jnp.sqrt(average((values - mean) ** 2))


def posterior(n):
    """On a grid of eight standard deviations about the mean, found from all of the
    prior on coarser ones."""
    center, width = prior_mean, 4 * prior_sd
    for points in (101, 41, n):
        grid, weight = on_grid(center, width, points)
        center, sd = moments(grid, weight)
        spacing = 2 * width / (points - 1)
        width = 8 * jnp.maximum(sd, spacing)
    return grid, weight  # pyright: ignore[reportPossiblyUnbound]


def error_of_mean(draws):
    """The Monte Carlo standard error of the mean, from means of fifty draws."""
    means = draws.reshape(-1, 50, draws.shape[-1]).mean(1)
    return means.std(0, ddof=1) / np.sqrt(len(means))


def picture(grid, weight, starts, draws):
    fig, axes = panels(2, 2, (4.6, 3.6))
    gamma, k = np.moveaxis(np.exp(np.asarray(grid)), -1, 0)
    points = np.exp(draws[:, ::10].reshape(-1, 2))
    axes[0].semilogx(*np.exp(starts).T, "s", color="tab:blue", label="starts")
    for ax in axes:
        ax.plot(*points.T, ".", ms=2, color="tab:orange", label="draws of NUTS")
        ax.plot(*truth, "*", ms=9, color="tab:red", label="truth")
        ax.set(xlabel="damping (1/s)", ylabel="stiffness (1/s²)")
    levels = np.asarray(weight.max()) * np.exp(-(np.arange(3, 0, -1) ** 2) / 2)
    axes[1].contour(gamma, k, weight, levels, colors="k", linewidths=1)
    axes[1].plot([], [], "k", lw=1, label="grid: 1, 2 and 3 sd")
    n = len(grid)
    middle = slice(n // 4, n - n // 4), n // 2
    axes[1].set_xlim(gamma[middle].min(), gamma[middle].max())
    axes[1].set_ylim(k[middle[::-1]].min(), k[middle[::-1]].max())
    for ax in axes:
        ax.legend(fontsize=8)
    save(fig, FOLDER / "samplers.png")


def main():
    parser = command_line(__doc__)
    parser.add_argument(
        "--plot", action="store_true", help="save docs/img/samplers.png"
    )
    options = parser.parse_args()
    chains, warmup, draws = (4, 200, 200) if options.quick else (8, 500, 1000)
    k = prior_mean[1] + prior_sd[1] * jax.random.normal(jax.random.key(0), (chains,))
    starts = jnp.stack([jnp.log(jnp.geomspace(0.01, 50.0, chains)), k], -1)
    grid, weight = posterior(41 if options.quick else 121)
    names = "damping", "stiffness"
    mean, sd = moments(jnp.exp(grid), weight)
    print(f"JAX {jax.__version__}, Diffrax {dfx.__version__}, {chains} chains")
    table = Table(
        f"Posterior from {draws} draws a chain; errors in Monte Carlo standard errors",
        *("sampler:<15", "unknown:<10", "mean:>8.4f", "error:>6.1f", "sd:>8.4f"),
        *("error:>6.1f", "divergent:>9", "in warm-up:>10", "seconds:>8.0f"),
    )
    none = None, None, None
    for i, name in enumerate(names):
        table.row("" if i else "grid", name, mean[i], None, sd[i], None, *none)
    for sampler, run in SAMPLERS.items():
        try:
            version = importlib.metadata.version(sampler)
        except importlib.metadata.PackageNotFoundError:
            print(f"{sampler} is not installed.")
            continue
        begin = time.perf_counter()
        found = run(log_density, starts, jax.random.key(1), warmup, draws)
        logs, *divergent = map(np.asarray, found)
        seconds = time.perf_counter() - begin
        last = *(*(str(x.sum()) for x in divergent), None)[:2], seconds
        if options.plot and run is by_blackjax:
            picture(grid, weight, starts, logs)
        values = np.exp(logs)
        squares = (values - values.mean((0, 1))) ** 2
        means, sds = values.mean((0, 1)), np.sqrt(squares.mean((0, 1)))
        z_mean = (means - mean) / error_of_mean(values)
        z_sd = (sds - sd) * 2 * sds / error_of_mean(squares)
        for i, name in enumerate(names):
            first = "" if i else f"{sampler} {version}"
            cells = means[i], z_mean[i], sds[i], z_sd[i]
            table.row(first, name, *cells, *(none if i else last))


if __name__ == "__main__":
    main()
