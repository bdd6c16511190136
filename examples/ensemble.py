"""An ensemble over all devices, and over processes: half a million pendulums at once.

Which minimum a damped pendulum settles in, for a grid of starting points that is split
over every device there is. Prints that the split solve equals the solve on one device,
and that its compiled program holds no communication; saves a picture.

    python examples/ensemble.py                 # the devices of this machine
    python examples/ensemble.py --devices 8     # as if the CPU were eight devices
    python examples/ensemble.py --processes 2   # two processes, on this machine
    srun python examples/ensemble.py --cluster  # one process per task of a cluster

On machines of your own, start one process on each, with `--processes`, `--process-id`
and the `--coordinator` that is process 0.
"""

import argparse
import collections
import contextlib
import pathlib
import re
import socket
import subprocess
import sys
import time
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import diffrax_presym as dps


matplotlib.use("Agg")
import matplotlib.pyplot as plt


jax.config.update("jax_enable_x64", True)

T1 = 60.0
OPERATION = re.compile(
    r" (all-gather|all-reduce|all-to-all|ragged-all-to-all|collective-broadcast|"
    r"collective-permute|reduce-scatter)(?:-start)?\("
)
FUNCTION = re.compile(r"^(?:ENTRY )?(%[\w.-]+) .*?^}", re.DOTALL | re.MULTILINE)


def pendulum():
    return dps.ConformalHamiltonian(
        dps.QuadraticKinetic(),
        lambda t, q, args: -jnp.sum(jnp.cos(q)),
        dps.ConstantDamping(0.1),
    )


def solver_of(hamiltonian, solver, dt0=0.25, throw=False, **kwargs):
    """The solve of one batch of starting points, from `y0` to the state at `T1`."""
    term = dps.HamiltonianTerm(hamiltonian)

    def solve(y0):
        # `throw=True` would ask all devices whether any of them failed.
        sol = dfx.diffeqsolve(
            term,
            solver,
            t0=0.0,
            t1=T1,
            dt0=dt0,
            y0=y0,
            max_steps=None,
            throw=throw,
            **kwargs,
        )
        return jax.tree.map(lambda y: y[-1], sol.ys)

    return jax.vmap(solve)


def compiled(solve, sharding, y0):
    shardings = jax.tree.map(lambda _: sharding, y0)
    fn = jax.jit(solve, in_shardings=(shardings,), out_shardings=shardings)
    return fn.lower(y0).compile()


def collectives(program):
    """The operations that make devices wait for each other: in loops, and outside."""
    # Functions of the compiled program start at the margin, and name those they call.
    texts = {m[1]: m[0] for m in FUNCTION.finditer(program.as_text())}
    looping, todo = set(), []
    for text in texts.values():
        todo += re.findall(r"(?:condition|body)=(%[\w.-]+)", text)
    while todo:
        name = todo.pop()
        if name in texts and name not in looping:
            looping.add(name)
            todo += re.findall(r"%[\w.-]+", texts[name])
    found = {True: collections.Counter(), False: collections.Counter()}
    for name, text in texts.items():
        found[name in looping].update(OPERATION.findall(text))
    return found[True], found[False]


def described(program):
    each = lambda found: ", ".join(f"{n} {name}" for name, n in found.items())
    inside, outside = map(each, collectives(program))
    found = [f"{inside} in each step"] * bool(inside)
    found += [f"{outside} in all"] * bool(outside)
    return " and ".join(found) or "none"


def starts(n):
    """A grid of `n * n` starting points, the same on every process."""
    q0, p0 = np.meshgrid(np.linspace(-np.pi, np.pi, n), np.linspace(-8, 8, n))
    return q0.ravel(), p0.ravel()


def split(y0, sharding):
    """Arrays over all devices; a process makes only the parts of its own devices."""
    place = lambda x: jax.make_array_from_callback(x.shape, sharding, lambda i: x[i])
    return jax.tree.map(place, y0)


def difference(ys, whole):
    """The largest difference on the devices of this process, and whether any is."""
    largest, bitwise = 0.0, True
    for y, w in zip(ys, whole, strict=True):
        for shard in y.addressable_shards:
            mine, theirs = np.asarray(shard.data), np.asarray(w)[shard.index]
            largest = max(largest, float(np.max(np.abs(mine - theirs))))
            bitwise = bitwise and bool(np.all(mine == theirs))
    return largest, bitwise


def patterns(sharding, y0):
    """What keeps a solve free of communication, and what does not."""
    leapfrog, tsit5 = dps.PresymplecticLeapfrog(), dfx.Tsit5()
    adapt: dict[str, Any] = dict(
        dt0=None, stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6)
    )
    points: dict[str, Any] = dict(saveat=dfx.SaveAt(ts=jnp.linspace(0.0, T1, 11)))
    grid: dict[str, Any] = dict(
        dt0=None, stepsize_controller=dfx.StepTo(jnp.linspace(0.0, T1, 241))
    )
    event = dfx.Event(lambda t, y, args, **kwargs: y[0] > 100.0)
    hamiltonian = pendulum()
    adaptive = solver_of(hamiltonian, tsit5, **adapt)
    # Each device runs a program of its own, whatever that is.
    alone = lambda solve: jax.shard_map(
        solve,
        mesh=sharding.mesh,
        in_specs=sharding.spec,
        out_specs=sharding.spec,
        check_vma=False,
    )
    cases = {
        "constant steps": solver_of(hamiltonian, leapfrog),
        "constant steps, SaveAt(ts=...)": solver_of(hamiltonian, leapfrog, **points),
        "StepTo": solver_of(hamiltonian, leapfrog, **grid),
        "constant steps, throw=True": solver_of(hamiltonian, leapfrog, throw=True),
        "constant steps, an event": solver_of(hamiltonian, leapfrog, event=event),
        "adaptive steps": adaptive,
        "adaptive steps, in shard_map": alone(adaptive),
        "an event, in shard_map": alone(solver_of(hamiltonian, leapfrog, event=event)),
    }
    print("\nCommunication in the compiled program of a solve with")
    for name, solve in cases.items():
        print(f"  {name:34}{described(compiled(solve, sharding, y0))}", flush=True)


def picture(path, n, q):
    wells = np.round(q.reshape(n, n) / (2 * np.pi))
    fig, ax = plt.subplots(figsize=(6.5, 5), layout="constrained")
    image = ax.imshow(
        wells,
        origin="lower",
        extent=(-np.pi, np.pi, -8, 8),
        cmap="twilight",
        aspect="auto",
        interpolation="nearest",
    )
    ax.set(
        title="Damped pendulum: the turns it makes before it settles",
        xlabel="initial angle (radians)",
        ylabel="initial momentum",
    )
    fig.colorbar(image, ax=ax, label="full turns")
    fig.savefig(path, dpi=150)


def simulate(options):
    n = 64 if options.quick else 720
    me, processes = jax.process_index(), jax.process_count()
    mesh = Mesh(np.array(jax.devices()), ("trajectories",))
    sharding = NamedSharding(mesh, PartitionSpec("trajectories"))
    y0 = starts(n)
    per_device = len(y0[0]) // mesh.size
    if len(y0[0]) % mesh.size:
        raise SystemExit(f"{n * n} starting points do not split over {mesh.size}.")
    if me == 0:
        print(
            f"{n * n} trajectories over {mesh.size} x {jax.devices()[0].device_kind}"
            f" in {processes} process(es), {per_device} on each device",
            flush=True,
        )
    solve = solver_of(pendulum(), dps.BlanesMoanRKN4())
    batch = split(y0, sharding)
    program = compiled(solve, sharding, batch)
    jax.block_until_ready(program(batch))
    start = time.perf_counter()
    ys = jax.block_until_ready(program(batch))
    seconds = time.perf_counter() - start
    whole = jax.jit(solve)(jax.tree.map(jnp.asarray, y0))
    largest, bitwise = difference(ys, whole)
    verdict = "bitwise equal" if bitwise else f"equal to {largest:.1e}"
    print(
        f"process {me}: {seconds:.2f} s; to the solve on one device: {verdict};"
        f" communication in the compiled program: {described(program)}",
        flush=True,
    )
    if processes == 1 and mesh.size > 1:
        patterns(sharding, batch)
    # Here, after the solve, the processes communicate for the first time.
    q = multihost_utils.process_allgather(ys[0], tiled=True)
    if me == 0:
        picture(options.output, n, np.asarray(q))
        print(f"Picture saved to {options.output}")


def launch(options):
    """All processes on this machine, which are ended whatever happens."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        coordinator = f"localhost:{probe.getsockname()[1]}"
    command = [sys.executable, *sys.argv, "--coordinator", coordinator, "--process-id"]
    with contextlib.ExitStack() as stack:
        children = []
        for k in range(options.processes):
            child = stack.enter_context(subprocess.Popen([*command, str(k)]))
            stack.callback(child.kill)
            children.append(child)
        deadline = time.monotonic() + options.timeout
        codes: list[int | None] = [None]
        # One that failed leaves the others waiting for it.
        while None in codes and not any(codes) and time.monotonic() < deadline:
            time.sleep(0.1)
            codes = [child.poll() for child in children]
    sys.exit(any(code != 0 for code in codes))


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a smaller run, for CI")
    parser.add_argument("--output", type=pathlib.Path, default="ensemble.png")
    parser.add_argument("--devices", type=int, help="split the CPU into so many")
    parser.add_argument("--processes", type=int, help="how many there are in all")
    parser.add_argument("--process-id", type=int, help="which of them this one is")
    parser.add_argument("--coordinator", help="host:port of process 0")
    parser.add_argument("--cluster", action="store_true", help="ask the scheduler")
    parser.add_argument("--timeout", type=float, default=600, help="seconds, at most")
    options = parser.parse_args()
    if options.processes and options.process_id is None:
        launch(options)
    # All of this before anything is computed, as JAX then looks for its devices.
    if options.devices:
        jax.config.update("jax_platforms", "cpu")
        jax.config.update("jax_num_cpu_devices", options.devices)
    if options.processes or options.cluster:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(
            options.coordinator, options.processes, options.process_id
        )
    simulate(options)
    if options.processes or options.cluster:
        jax.distributed.shutdown()


if __name__ == "__main__":
    main()
