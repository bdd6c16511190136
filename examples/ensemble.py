"""An ensemble over all devices and processes: half a million pendulums.

Computes the minimum in which a damped pendulum settles, for a grid of initial states
that is split over all devices. Prints whether the result equals that of one device, and
the communication in the compiled program; saves a figure.

    python examples/ensemble.py                 # the devices of this machine
    python examples/ensemble.py --devices 8     # the CPU as eight devices
    python examples/ensemble.py --processes 2   # two processes, on this machine
    srun python examples/ensemble.py --cluster  # one process per task of a cluster

On machines without a scheduler, start one process on each, with `--processes`,
`--process-id`, and the address of process 0 as `--coordinator`.
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
from diffrax_presym.extend import AbstractPresymplecticSolver


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
    return dps.MechanicalSystem(
        dps.QuadraticKinetic(),
        lambda t, q, args: -jnp.sum(jnp.cos(q)),
        dps.ConstantDamping(0.1),
    )


def solver_of(system, solver, dt0=0.25, throw=False, **kwargs):
    """The solve of a batch of initial states, from `y0` to the state at `T1`."""
    own = isinstance(solver, AbstractPresymplecticSolver)
    if own and "event" not in kwargs:  # the loop of Diffrax takes events
        kwargs.setdefault("adjoint", dps.FixedStepAdjoint())

    def solve(y0):
        # `throw=True` would check for failures across all devices.
        sol = dfx.diffeqsolve(
            system,
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
    """Counts of collective operations, in loops and outside of loops."""
    # Functions of the compiled program are not indented, and name those they call.
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


def described(program, iteration="in each step"):
    each = lambda found: ", ".join(f"{n} {name}" for name, n in found.items())
    inside, outside = map(each, collectives(program))
    found = [f"{inside} {iteration}"] * bool(inside)
    found += [f"{outside} in all"] * bool(outside)
    return " and ".join(found) or "none"


def starts(n):
    """A grid of `n * n` initial states, the same on every process."""
    q0, p0 = np.meshgrid(np.linspace(-np.pi, np.pi, n), np.linspace(-8, 8, n))
    return q0.ravel(), p0.ravel()


def split(y0, sharding):
    """Arrays over all devices; a process creates only the parts of its own devices."""
    place = lambda x: jax.make_array_from_callback(x.shape, sharding, lambda i: x[i])
    return jax.tree.map(place, y0)


def difference(ys, whole):
    """The largest difference on the devices of this process, and bitwise equality."""
    largest, bitwise = 0.0, True
    for y, w in zip(ys, whole, strict=True):
        for shard in y.addressable_shards:
            mine, theirs = np.asarray(shard.data), np.asarray(w)[shard.index]
            largest = max(largest, float(np.max(np.abs(mine - theirs))))
            bitwise = bitwise and bool(np.all(mine == theirs))
    return largest, bitwise


def patterns(sharding, y0):
    """Print the communication of several kinds of solves."""
    leapfrog, tsit5 = dps.PresymplecticLeapfrog(), dfx.Tsit5()
    adapt: dict[str, Any] = dict(
        dt0=None, stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6)
    )
    points: dict[str, Any] = dict(saveat=dfx.SaveAt(ts=jnp.linspace(0.0, T1, 11)))
    grid: dict[str, Any] = dict(
        dt0=None, stepsize_controller=dfx.StepTo(jnp.linspace(0.0, T1, 241))
    )
    event = dfx.Event(lambda t, y, args, **kwargs: y[0] > 100.0)
    system = pendulum()
    adaptive = solver_of(system, tsit5, **adapt)
    # Each device runs its own program.
    alone = lambda solve: jax.shard_map(
        solve,
        mesh=sharding.mesh,
        in_specs=sharding.spec,
        out_specs=sharding.spec,
        check_vma=False,
    )
    cases = {
        "constant steps": solver_of(system, leapfrog),
        "constant steps, SaveAt(ts=...)": solver_of(system, leapfrog, **points),
        "StepTo": solver_of(system, leapfrog, **grid),
        "constant steps, throw=True": solver_of(system, leapfrog, throw=True),
        "constant steps, an event": solver_of(system, leapfrog, event=event),
        "adaptive steps": adaptive,
        "adaptive steps, in shard_map": alone(adaptive),
        "an event, in shard_map": alone(solver_of(system, leapfrog, event=event)),
    }
    print("\nCommunication in the compiled program of a solve with")
    for name, solve in cases.items():
        # A batch asks there whether all of its members are lost.
        iteration = "at each saved time" if "ts" in name else "in each step"
        found = described(compiled(solve, sharding, y0), iteration)
        print(f"  {name:34}{found}", flush=True)


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
        title="Damped pendulum: full turns before it settles",
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
        raise SystemExit(
            f"{n * n} initial states cannot be split over {mesh.size} devices."
        )
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
        f"process {me}: {seconds:.2f} s; compared with one device: {verdict};"
        f" communication in the program: {described(program)}",
        flush=True,
    )
    if processes == 1 and mesh.size > 1:
        patterns(sharding, batch)
    # The first communication between processes, after the solve.
    q = multihost_utils.process_allgather(ys[0], tiled=True)
    if me == 0:
        picture(options.output, n, np.asarray(q))
        print(f"Figure saved to {options.output}")


def launch(options):
    """Start all processes on this machine, and terminate them in any case."""
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
        # If one process fails, the others would wait for it.
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
    parser.add_argument("--devices", type=int, help="number of devices of the CPU")
    parser.add_argument("--processes", type=int, help="total number of processes")
    parser.add_argument("--process-id", type=int, help="index of this process")
    parser.add_argument("--coordinator", help="host:port of process 0")
    parser.add_argument(
        "--cluster", action="store_true", help="detect processes from the scheduler"
    )
    parser.add_argument("--timeout", type=float, default=600, help="in seconds")
    options = parser.parse_args()
    if options.processes and options.process_id is None:
        launch(options)
    # Before any computation, when JAX initialises its devices.
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
