# pyright: reportArgumentType=false
"""What the catalogue says is refused raises an error that says what to write."""

import itertools
import random
import re
from functools import cache

import catalogue
import diffrax as dfx
import jax
import jax.numpy as jnp
import pytest
from catalogue import build, claim, offered, Problem, Refused
from on_manifolds import bobs, CASES, DRIFTS, links, start
from rows import SAMPLE

import diffrax_presym as dps


@cache
def refusals() -> dict[str, list[tuple]]:
    """By scheme, what it must refuse: of systems that differ in nothing that matters,
    one. Without a scheme, systems that do not take a friction."""
    found, seen = {}, set()
    for system, friction in itertools.product(catalogue.SYSTEMS, catalogue.FRICTION):
        splits = offered(system, friction)
        if isinstance(splits, Refused):
            found.setdefault("systems", []).append((system, friction, None))
            continue
        for scheme in catalogue.SCHEMES:
            key = scheme, friction, splits
            if isinstance(claim(system, friction, scheme), Refused) and key not in seen:
                seen.add(key)
                found.setdefault(str(scheme), []).append((system, friction, scheme))
    return found


def check_refusal(system, friction, scheme):
    """An error before any compute that says what to write instead."""
    with pytest.raises(ValueError) as error:
        built = build(system, friction)
        y0 = jax.tree.map(jnp.asarray, catalogue.start(system, friction))
        solver = dfx.Tsit5() if scheme is None else scheme.solver
        problem = Problem(built, solver, 0.5, 1.0, dfx.RecursiveCheckpointAdjoint())
        jax.eval_shape(lambda: problem.solve(0.1, y0, dfx.SaveAt(t1=True)).ys)
    assert re.search("(?i)write|use |pass ", str(error.value)), error.value


@pytest.mark.parametrize("case", [case for case in CASES if case not in DRIFTS])
def test_nystrom_schemes_on_manifolds_refuse_friction_in_kicks(case):
    message = r"`TunedRKN6` keeps its order.*one rate.*`BlanesMoan6\(\)`"
    problem = CASES[case][0], dps.TunedRKN6(), 0.0, 1.0, 0.1, start(case)
    with pytest.raises(ValueError, match=message):
        dfx.diffeqsolve(*problem)


def test_nystrom_schemes_refuse_constraints():
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: jnp.sum(q))
    y0 = bobs([0.5, 1.0]), jnp.zeros((2, 2))
    problem = dps.ConstrainedSystem(free, links), dps.TunedRKN6(), 0.0, 1.0, 0.1, y0
    message = r"`TunedRKN6` keeps its order.*only without constraints.*Strang"
    with pytest.raises(ValueError, match=message):
        dfx.diffeqsolve(*problem)


def check_composition(scheme, wrapper):
    with pytest.raises(ValueError) as error:
        solver = wrapper.wrap(scheme.solver)
        system = build(catalogue.SYSTEMS[0], catalogue.FRICTION[0])
        y0 = catalogue.start(catalogue.SYSTEMS[0], catalogue.FRICTION[0])
        y0 = jax.tree.map(jnp.asarray, y0)
        jax.eval_shape(lambda: solver.init(system, 0.0, 1.0, y0, None))
    assert re.search("(?i)write|use |compose ", str(error.value)), error.value


@pytest.mark.parametrize("scheme", list(refusals()))
@pytest.mark.slow
def test_refusals(scheme, record_property):
    for refusal in refusals()[scheme]:
        check_refusal(*refusal)
    record_property("refused", len(refusals()[scheme]))


def test_some_refusals(record_property):
    everything = [x for some in refusals().values() for x in some]
    number = min(20 * SAMPLE, len(everything))
    for refusal in random.Random(0).sample(everything, number):
        check_refusal(*refusal)
    record_property("refused", number)
    for scheme, wrapper in itertools.product(catalogue.SCHEMES, catalogue.WRAPPERS):
        if wrapper.composes and not scheme.composable:
            check_composition(scheme, wrapper)
