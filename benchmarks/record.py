"""The final states of all schemes on all systems and kinds of friction, to compare two
versions of the package: `record.py FILE` writes them, or prints how they differ from
those in FILE. Also the seconds to compile each, and the microseconds that it runs.
"""

import json
import pathlib
import sys
import time


sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "tests"))

import catalogue
import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import test_pairs


STEPS = 24


def cases():
    """Each scheme on each system with the first friction that it takes, and with each
    friction on the first system."""
    seen = set()
    for scheme in catalogue.SCHEMES:
        for friction in catalogue.FRICTION:
            for system in catalogue.SYSTEMS:
                if isinstance(
                    catalogue.claim(system, friction, scheme), catalogue.Refused
                ) or catalogue.fails(system, friction, scheme, catalogue.WRAPPERS[0]):
                    continue
                new = {(scheme, friction), (scheme, system)} - seen
                if new:
                    seen |= new
                    yield scheme, friction, system


def run(scheme, friction, system):
    t0, t1 = catalogue.span(system, friction)
    y0 = jax.tree.map(jnp.asarray, catalogue.start(system, friction))
    problem = catalogue.Problem(
        test_pairs.build(system, friction),
        test_pairs.make(scheme, "float64"),
        jnp.asarray(t0),
        jnp.asarray(t1),
        dfx.RecursiveCheckpointAdjoint(),
    )
    save = dfx.SaveAt(t1=True)
    solve = jax.jit(lambda y0: problem.solve(problem.length(STEPS), y0, save).ys)
    start = time.perf_counter()
    compiled = solve.lower(y0).compile()
    seconds, times = time.perf_counter() - start, []
    y = compiled(y0)
    for _ in range(20):
        start = time.perf_counter()
        y = jax.block_until_ready(compiled(y0))
        times.append(time.perf_counter() - start)
    return test_pairs.flat(y).tolist(), seconds, 1e6 * float(np.median(times))


def main():
    jax.config.update("jax_enable_x64", True)
    path = pathlib.Path(sys.argv[1])
    before = json.loads(path.read_text()) if path.exists() else None
    record, ratios = {}, []
    for i, case in enumerate(cases()):
        name = " | ".join(map(str, case))
        y, seconds, micro = run(*case)
        record[name] = y, seconds, micro
        if i % 20 == 19:
            eqx.clear_caches()
        if before is None or name not in before:
            continue
        z, old_seconds, old_micro = before[name]
        ratios.append((seconds / old_seconds, micro / old_micro))
        difference = np.max(np.abs(np.subtract(y, z)))
        if not difference <= 1e-12:
            print(f"{name}: {difference:.1e}", flush=True)
    if before is None:
        path.write_text(json.dumps(record))
    else:
        compile_time, run_time = np.exp(np.mean(np.log(ratios), axis=0))
        print(f"{len(ratios)} cases; compile {compile_time:.2f}, run {run_time:.2f}")


if __name__ == "__main__":
    main()
