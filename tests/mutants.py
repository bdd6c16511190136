"""Deliberate errors, and whether the tests find them.

`python tests/mutants.py [NAME ...]` applies each to a copy of the package, runs a
sample of the rows of the catalogue that have the entries it concerns, and prints found
or missed. An error is found if a test fails. What is not part of a pair, as a potential
or a diagnostic, is looked for by the tests that an error names.
"""

import argparse
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
from typing import NamedTuple


ROOT = pathlib.Path(__file__).parents[1]


class Mutant(NamedTuple):
    name: str
    file: str  # in the package
    old: str
    new: str
    of: tuple[str, ...] = ()  # what it concerns: entries that the rows have
    tests: str = "test_pairs.py"
    only: str = ""  # of these tests


MUTANTS = [
    # Friction.
    Mutant("Gauss: the frames of the stages to the middle for both directions",
        "_scheme/_gauss.py", "[lengths, to_middle, -to_middle]",
        "[lengths, to_middle, to_middle]", ("Gauss 4",)),
    Mutant("Gauss: one exponential for the frames of all stages", "_scheme/_gauss.py",
        "to_middle = h / 2, (cast_to(0.5, h) - nodes) * h",
        "to_middle = h / 2, (cast_to(0.5, h) - nodes[:1] + 0 * nodes) * h",
        ("Gauss 4",)),
    Mutant("a rate that varies is accepted in the shared frame",
        "_system/_mechanical.py",
        "constant = all(part.log_scale.is_autonomous for part in parts.linear)",
        "constant = True", tests="test_refusals.py"),
    Mutant("multistep: the history is kept where the length of a step changes",
        "_scheme/_multistep.py", "return jnp.where(same, carry.steps, 0)",
        "return carry.steps", tests="test_multistep.py"),
    Mutant("multistep: the history starts one step too early", "_scheme/_multistep.py",
        "is_short = steps < self.order - 1", "is_short = steps < self.order - 2",
        ("multistep 8",)),
    Mutant("multistep: the history is not carried into the frame of the end",
        "_scheme/_multistep.py", "history = map(move, (old.filter, old.force, kick))",
        "history = old.filter, old.force, kick", ("multistep 8", "constant")),
    Mutant("no closed form of the logarithm", "_friction/_log_scale.py",
        "return Effect(expm1(-rate * x), carried, responded)",
        "return by_quadrature([(self, rate)], t, h, order)", ("3 / t",)),
    Mutant("the start of a singular law is not a case of its own",
        "_friction/_log_scale.py",
        "jnp.where(singular, _ALL_LOST, jnp.log1p(as_time(h) / since))",
        "jnp.log1p(as_time(h) / self._after(t))", ("3 / t",)),
    Mutant("a wrong sign in an integral", "_friction/_log_scale.py",
        "expm1_and_ratio((1 - rate) * x)", "expm1_and_ratio((1 + rate) * x)",
        ("3 / t",)),
    Mutant("an order of quadrature too low", "_friction/_exponential.py",
        "leggauss((order + 1) // 2)", "leggauss(max(1, (order - 1) // 2))",
        ("eta(t)",)),
    Mutant("the integral of a decaying matrix for the whole time, twice",
        "_friction/_leaf.py", "for x in effect[:2])",
        "for x in (effect[0], effect[0]))", ("matrix",)),
    Mutant("too few terms", "_friction/_exponential.py", "_TERMS = 14", "_TERMS = 5",
        ("matrix",)),
    Mutant("one part of the time too few", "_friction/_exponential.py",
        "most = jnp.minimum(parts, 2.0**_SQUARINGS)",
        "most = jnp.minimum(parts, 2.0**_SQUARINGS) - 1",
        ("operator", "unequal steps")),
    Mutant("a law in time is prepared once", "_friction/_leaf.py",
        "return all(law.is_autonomous for law, _ in self.terms)", "return True",
        ("2 / (t + 1)",)),
    Mutant("drag to order 1", "_friction/_drag.py", "-x / (1 + x)", "-x", ("drag",)),
    Mutant("a wind with the wrong sign", "_friction/_drag.py", "p / mass - w",
        "p / mass + w", ("[constant, drag]",)),
    # Moves.
    Mutant("what a drift prepares is that of another time", "_scheme/_moves.py",
        "return split.prepare(system, span.t0, span.h, self.order)",
        "return split.prepare(system, span.t1, span.h, self.order)", ("2 / (t + 1)",)),
    Mutant("a kick at the wrong time", "_scheme/_moves.py",
        "        force = split.force(system, span.t0, y)\n",
        "        force = split.force(system, span.t0 + span.h / 100, y)\n",
        ("driven",)),
    Mutant("a frozen drift takes the velocity at the wrong time", "_scheme/_moves.py",
        "velocity = system.velocity(span.t0, y)",
        "velocity = system.velocity(span.t1, y)", ("dissipative",)),
    Mutant("a copy does not decay", "_scheme/_tao.py",
        "(system.decay(data, copy), field)", "(copy, field)", ("Tao 4",)),
    Mutant("the adjoint sequence in the wrong order", "_scheme/_engine.py",
        "moves = [inverse(move) for move in self.moves[::-1]]",
        "moves = [inverse(move) for move in self.moves]", ("leapfrog",)),
    Mutant("times of the inverse are not turned", "_scheme/_engine.py",
        "np.stack([1 - end, 1 - start, length], axis=-1)",
        "np.stack([start, end, length], axis=-1)", ("driven",)),
    Mutant("a wrapper mixes up what it carries", "_scheme/_moves.py",
        "return (system.values(y), (carry, tree.rounding_errors(y))), None",
        "return (system.values(y), (tree.rounding_errors(y), carry)), None",
        ("Compensated",)),
    Mutant("a wrapper passes on the wrong part of what it carries",
        "_scheme/_compensated.py", "end_force=lambda carry: base.end_force(carry[0]),",
        "end_force=lambda carry: base.end_force(carry[1][0]),",
        ("Diffrax's loop, dense", "Compensated")),
    Mutant("a stage backwards in time may amplify without limit", "_scheme/_engine.py",
        "-span.h) > -math.log(friction.precision) / 2", "-span.h) > math.inf",
        tests="test_strong_friction.py"),
    # The loop and its gradient.
    Mutant("a saved row is shifted by one", "_loop/_tracks.py",
        "y = self.stencils.combine(j, n, ring)",
        "y = self.stencils.combine(jnp.maximum(j - 1, 0), n, ring)",
        tests="test_between_steps.py"),
    Mutant("the second derivative at a node is that in another unit of time",
        "_loop/_nodes.py", "(d * unit) * (", "d * (1 if k else unit) * (",
        tests="test_between_steps.py"),
    Mutant("nodes are those of both sides of a kink", "_loop/_nodes.py",
        "first = jnp.maximum(first, low)", "first = jnp.maximum(first, 0)",
        tests="test_between_steps.py"),
    Mutant("values between steps are interpolated whatever the friction",
        "_loop/_base.py", "most <= MOST_FRICTION", "most < jnp.inf",
        tests="test_between_steps.py"),
    Mutant("nodes are those where friction is strong", "_loop/_nodes.py",
        "& (first < first_node)", "& (first + 2 < first_node)",
        tests="test_shorter_steps.py"),
    Mutant("the derivatives at a kink are those after it", "_loop/_tracks.py",
        "lambda: self.node(n, -kink, point)", "lambda: self.node(n, kink, point)",
        tests="test_between_steps.py"),
    Mutant("the cotangent of a node is not cleared", "_loop/_pull.py",
        "return at, put(bars, n % NODES, zeros(bar))", "return at, bars",
        tests="test_between_steps.py"),
    Mutant("a saved time is that of the end of its step", "_loop/_problem.py",
        "within(jnp.where(ended, n - 1, n), start, t)",
        "within(jnp.where(ended, n - 1, n), start, end)", ("times",)),
    Mutant("equal steps of the length asked for", "_loop/_steps.py",
        "self.length = jnp.where(finite, spans / several, dt0)",
        "self.length = jnp.where(finite, spans / several * 1.001, dt0)", ("end",)),
    Mutant("a last step is left out", "_loop/_steps.py",
        "self.first, self.count = last - counts, last[-1]",
        "self.first, self.count = last - counts, last[-1] - 1", ("end",)),
    Mutant("the cotangents of what a step holds are dropped", "_loop/_backward.py",
        "gradient, ends = tree.add(at.gradient, more)",
        "gradient, ends = tree.add(at.gradient, zeros(more))", ("reversal",)),
    Mutant("variable steps do not depend on the state in gradients",
        "_loop/_variable.py",
        "h = jnp.where(is_last, t1 - t, h)",
        "h = jnp.where(is_last, t1 - t, lax.stop_gradient(h))",
        tests="test_variable_loop.py"),
    Mutant("the controller is not run backwards", "_loop/_variable.py",
        "control = self.controller.reverse(t.value, y, system.args, control)", "",
        tests="test_variable_loop.py"),
    Mutant("a batch ends for each member on its own", "_loop/_run.py",
        "more = lambda x: tree.any_member(x[-1])", "more = lambda x: x[-1]",
        tests="test_between_steps.py", only="copies"),
    Mutant("a coefficient of the elliptic functions", "_system/_free_rotation.py",
        "square * (1 / 10", "square * (1 / 11", tests="test_free_rotation.py",
        only="periods"),
    Mutant("the derivative of a small rotation without its commutator",
        "_system/_free_rotation.py", "dangle - turning / 2 +", "dangle +",
        tests="test_free_rotation.py", only="derivatives"),
    Mutant("the angle of a rotation by inertia does not include its work",
        "_system/_free_rotation.py", "work += s / 2 * (p**2 + mean) * drates",
        "work += s / 2 * p**2 * drates", tests="test_free_rotation.py",
        only="derivatives"),
    Mutant("momenta are not projected at the end of a step",
        "_system/_constrained_split.py",
        'if self.base.kick_by == "force" else y', "if False else y",
        tests="test_constrained.py"),
    Mutant("an elimination of diagonals has no pivots", "_system/_multipliers.py",
        "jnp.abs(after[0]) > jnp.abs(row[0])", "jnp.abs(row[0]) < 0",
        tests="test_multipliers.py", only="diagonals_by_pivots"),
    Mutant("other entries than three diagonals are ignored", "_system/_multipliers.py",
        "jnp.where(are_all, ", "jnp.where(True, ", tests="test_multipliers.py",
        only="joins"),
    Mutant("the time at which the most steps end is given", "_loop/_backward.py",
        "return time, functions.outputs[i](time, point[0])",
        "return lax.stop_gradient(time), functions.outputs[i](time, point[0])",
        tests="test_variable_saved.py", only="most_steps"),
    Mutant("Newton's method ends after one correction", "_system/_multipliers.py",
        "found &= bend <= 2 * limit * before",
        "found = ~(bend > 2 * limit * before)",
        tests="test_multipliers.py", only="near_the_origin"),
    Mutant("the corners of a matrix are two of three diagonals",
        "_system/_multipliers.py", "jnp.pad(x, 1)[k : k + x.size]",
        "jnp.roll(x, 1 - k)", tests="test_multipliers.py", only="ring"),
    Mutant("a force on a part that no constraint is about", "_implicit.py",
        "x + total.astype(x.dtype)", "x",
        tests="test_multipliers.py", only="not_constrained"),
    Mutant("the numbers that are tried are those of steps",
        "_step_size/_solution.py", "number * self.steps / self.number if self.finite",
        "number if self.finite", tests="test_step_density.py", only="unit_of_time"),
    Mutant("a step of no length has an equation for multipliers",
        "_system/_constrained_split.py", "jnp.where(h == 0, x, value)", "value",
        tests="test_multipliers.py", only="no_length"),
    Mutant("the pivot of an elimination is the diagonal", "_system/_multipliers.py",
        "row == jnp.argmax(size)", "row == k", tests="test_multipliers.py",
        only="pivots"),
    Mutant("forces of the velocity leave a manifold", "_system/_manifold.py",
        "return tree.add(force, self._tangential(q, other))",
        "return tree.add(force, other)", tests="test_manifolds.py",
        only="Stiefel and force and undone or Stiefel and force and Strang"),
    Mutant("forces of bodies by their momenta", "_system/_manifold.py",
        "state = t, q, p, self._along_axes(p), args", "state = t, q, p, p, args",
        tests="test_manifolds.py", only="controlled and Strang"),
    Mutant("a row of variable steps is found a step before", "_loop/_within.py",
        "Found(n, ", "Found(n - 1, ", tests="test_variable_saved.py", only="gradients"),
    Mutant("ends of steps do not vary", "_loop/_pull.py", "times = bars[0] +",
        "times = bars[0] + 0 *", tests="test_variable_saved.py", only="gradients"),
    Mutant("the times of steps have no derivatives", "_loop/_problem.py",
        "self.steps.begin(n, start)", "lax.stop_gradient(self.steps.begin(n, start))",
        tests="test_variable_saved.py", only="of_their_times"),
    Mutant("stages of collocation by the momenta of the last round",
        "_scheme/_gauss_solve.py", "velocities = self.velocities(q, p)",
        "velocities = self.velocities(q, stages[1])", tests="test_collocation.py"),
    Mutant("a restarted iteration keeps slopes that are not finite",
        "_scheme/_gauss_solve.py",
        "start((step.stages(nothing), nothing), (stages, slopes))",
        "start((step.stages(nothing), slopes), (stages, slopes))",
        tests="test_collocation.py"),
    Mutant("a linear system that is not solved has numbers", "_implicit.py",
        "return tree.invalid_if(found.result != lx.RESULTS.successful, found.value)",
        "return found.value", tests="test_multipliers.py"),
    Mutant("what all steps share is not differentiated", "_loop/_problem.py",
        "data = steps.prepare(scheme, system, backward=False)",
        "data = lax.stop_gradient(steps.prepare(scheme, system, backward=False))",
        ("constant", "reversal")),
    Mutant("a step between checkpoints is pulled back from the one before",
        "_loop/_kept.py", "lambda x: x[n - first]",
        "lambda x: x[jnp.maximum(n - first - 1, 0)]", ("checkpoints",)),
    Mutant("a kept state is not the start of its step", "_loop/_kept.py",
        "n == first, lambda: known", "n == first - 1, lambda: known",
        tests="test_kept_states.py", only="is_lost"),
    Mutant("the error of recomputed states is not looked at", "_loop/_kept.py",
        "size(tree.sub(*at.ends))", "0 * size(tree.sub(*at.ends))",
        tests="test_kept_states.py", only="is_lost"),
    Mutant("a lost gradient is an error in a batch too", "_loop/_kept.py",
        "missed = _error_unless_batched(missed)",
        "missed = eqx.error_if(missed, missed, _NOT_RECOMPUTED)",
        tests="test_kept_states.py", only="is_lost or not_taken"),
    Mutant("the inverse of a step has no derivative", "_loop/_problem.py",
        "self.undo = convert(undo, n, start)",
        "self.undo = tree.stop_gradient(convert(undo, n, start))",
        tests="test_adjoint.py", only="second_derivatives"),
    Mutant("gaps in the saved times have values", "_loop/_rows.py",
        "return self.reached(n) & (self.stop >= 0)", "return self.reached(n)",
        tests="test_steps.py"),
    Mutant("steps go on after a failure", "_loop/_run.py",
        "return some & tree.all_finite(point[0])", "return some",
        tests="test_steps.py"),
    Mutant("an infinite step is none", "_loop/_steps.py",
        "jnp.where(spans > 0, jnp.maximum(numbers, 1), numbers)", "numbers",
        tests="test_steps.py"),
    Mutant("prescribed steps may end anywhere", "_loop/_steps.py",
        "eqx.error_if(controller.ts, ~ends, _OTHER_ENDS)", "controller.ts",
        tests="test_steps.py"),
    # Extensions.
    Mutant("what a move prepares is shared by all stages", "_scheme/_engine.py",
        "return type(self).prepare is AbstractMove.prepare", "return True",
        ("own moves",)),
    Mutant("a term holds an empty tuple", "_system/_mechanical.py",
        "as_laws(friction) or None", "as_laws(friction)",
        tests="test_diffrax_adjoints.py", only="pendulum-none"),
    Mutant("the cotangent of the last of the rows is dropped", "_loop/_pull.py",
        "number = problem.rows[i].first_left(backward.trace.n)",
        "number = problem.rows[i].first_left(backward.trace.n) - 1",
        ("times", "reversal")),
    Mutant("members keep the fewest", "_loop/_kept.py", "jnp.where(room, least, every)",
        "tree.largest_member(every)", tests="test_kept_states.py", only="keep_what"),
    Mutant("outputs of the end are not pulled back", "_loop/_backward.py",
        "at = at.add(*self._pull_point(i, n, point, row))",
        "at = at.add(zeros(at.gradient), zeros(at.bar))",
        ("everything", "reversal")),
    Mutant("an infinite span takes no step", "_loop/_steps.py",
        "jnp.where(finite, numbers, 0).astype(int), most)",
        "jnp.where(finite, numbers, 0).astype(int), 0)", tests="test_steps.py"),
    # Forces.
    Mutant("a wrong sign in a force term", "_system/_lagrangian.py",
        "return kinetic - self._potential(t, q, args)",
        "return -kinetic - self._potential(t, q, args)", ("M(q)",)),
    Mutant("the distance of a particle to itself has a derivative",
        "_system/_pairwise.py", "jnp.sqrt(jnp.where(apart, square, 1))",
        "jnp.sqrt(square)", tests="test_pairwise.py"),
    Mutant("the energy of a particle with itself is that at the distance one",
        "_system/_pairwise.py",
        "jnp.where(same, lax.stop_gradient(following)[:, None], square)",
        "jnp.where(same, 1, square)", tests="test_pairwise.py"),
    # Diagnostics.
    Mutant("the fastest solve is taken without a look at its error",
        "diagnostics/_work_precision.py",
        "[run for run in self.runs if run.error <= error]", "list(self.runs)",
        tests="test_work_precision.py"),
    # What is refused.
    Mutant("Nystrom splittings take friction by place", "_system/_mechanical.py",
        'KineticSplit(frozenset({"any"}), "friction")',
        'KineticSplit(frozenset({"any", "nystrom"}), "friction")',
        tests="test_refusals.py"),
]  # fmt: skip


def found(mutant: Mutant, rows: int) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        copy = pathlib.Path(folder)
        for part in ("diffrax_presym", "tests"):
            shutil.copytree(ROOT / part, copy / part)
        shutil.copytree(ROOT / "docs", copy / "docs")
        shutil.copy(ROOT / "pyproject.toml", copy)
        path = copy / "diffrax_presym" / mutant.file
        text = path.read_text()
        assert mutant.old in text, f"{mutant.name}: not found in {mutant.file}"
        path.write_text(text.replace(mutant.old, mutant.new))
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "2"]
        command += ["-p", "no:cacheprovider", f"tests/{mutant.tests}"]
        sampled = mutant.tests in ("test_pairs.py", "test_refusals.py")
        command += ["-m", "not slow"] if sampled else []
        command += ["-k", mutant.only] if mutant.only else []
        environment = os.environ | {"PYTHONPATH": folder, "ROWS": str(rows)}
        environment["ENTRIES"] = "|".join(mutant.of)
        run = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True
        )
        # Where the first failure ends a run of several processes, the status is 2.
        failed, passed = (word in run.stdout for word in ("FAILED tests", "passed in"))
        if not failed and (run.returncode or not passed):
            raise RuntimeError(f"The tests did not run:\n{run.stdout[-2000:]}")
        return failed


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="words in the names of some of them")
    parser.add_argument("--rows", type=int, default=24, help="the size of the sample")
    options = parser.parse_args()
    number = 0
    chosen = [
        mutant
        for mutant in MUTANTS
        if not options.names or any(word in mutant.name for word in options.names)
    ]
    for mutant in chosen:
        right = found(mutant, options.rows)
        number += right
        print(f"{'found ' if right else 'MISSED'} {mutant.name}", flush=True)
    print(f"{number} of {len(chosen)} found")


if __name__ == "__main__":
    main()
