"""How the coefficients of `TunedRKN6` and `TunedLinear8` were found, and what they buy.

For each Runge-Kutta-Nyström splitting it prints the longest step times frequency, per
force evaluation, at which one step of an oscillator errs by less than 1e-3, 1e-6 and
1e-9; and the remaining errors of a step at degrees 3, 5 and 7 for any force, per
evaluation. Then it rounds the coefficients of `TunedRKN6` to three digits, and
restarts the optimiser, which finds equally good ones.

`--search linear` and `--search rkn` start from random numbers instead and print the
best coefficients found so far. Most starts end in poor minima: the committed ones took
some hundreds. Of two dozen weights of the objective of `TunedRKN6`, those chosen gave
about the smallest errors on five of the problems of `work_precision.py`.

A step of an oscillator over z, step times frequency, is [[P, z A], [-z B, P]] with
polynomials P, A, B in s = z^2, where P^2 + s A B = 1; and such polynomials are those of
a splitting, by Euclid's algorithm. `TunedLinear8` was found as the polynomials nearest
to cos(z), sin(z) / z and sin(z) / z. The objective of `TunedRKN6` is the same error,
and that of degree 7 for any force, and its starts are splittings for oscillators, moved
to where the conditions of order 6 hold. These are on words in two letters, the flows A
and B of drift and kick, modulo [B, [B, [B, A]]] = 0.
"""

import itertools
import math
import time

import jax
import jax.numpy as jnp
import mpmath  # pyright: ignore[reportMissingImports]
import numpy as np
from _polynomials import euclid, frequencies, LinearProblem, Problem, STAGES
from _report import command_line, Table

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

DEGREE = 7
SCHEMES = ("BlanesMoanRKN4", "BlanesMoanRKN6", "BlanesCasasRKN8")
TUNED = ("TunedRKN6", "TunedLinear8")


def oscillator(moves, kick_first, z):
    """The matrices of a step, less those of a rotation by `z`."""
    rows = [[jnp.full_like(z, i == j) for j in (0, 1)] for i in (0, 1)]
    for i, move in enumerate(moves):
        to, sign = (1, -1) if (i % 2 == 0) == kick_first else (0, 1)
        pair = zip(rows[to], rows[1 - to], strict=True)
        rows[to] = [x + sign * move * z * y for x, y in pair]
    cos, sin = jnp.cos(z), jnp.sin(z)
    return jnp.array(rows) - jnp.array([[cos, sin], [-sin, cos]])


def reach(moves, kick_first, target):
    """The longest step times frequency, per evaluation, with errors below `target`."""
    stages = len(moves) // 2
    z = jnp.linspace(0.002, 2, 1000) * stages
    errors = jnp.max(jnp.abs(oscillator(moves, kick_first, z)), axis=(0, 1))
    first = int(jnp.argmax(errors > target))
    return float(z[max(first - 1, 0)]) / stages


# Errors of a step for any force: coefficients of words in A and B, A a drift.

WORDS = [w for n in range(DEGREE + 1) for w in itertools.product("AB", repeat=n)]
INDEX = {word: i for i, word in enumerate(WORDS)}


def _append(letter):
    """The powers, over factorials, of the map that appends a letter to all words."""
    matrix = np.zeros((len(WORDS), len(WORDS)))
    for word in WORDS:
        if len(word) < DEGREE:
            matrix[INDEX[word], INDEX[*word, letter]] = 1
    powers = [np.eye(len(WORDS))]
    for k in range(1, DEGREE + 1):
        powers.append(powers[-1] @ matrix / k)
    return jnp.array(powers)


APPEND = {letter: _append(letter) for letter in "AB"}
FLOW = jnp.array([1 / math.factorial(len(word)) for word in WORDS])


def _modulo_nystroem(degree):
    """A basis of the words of a degree modulo [B, [B, [B, A]]] = 0."""
    relation = {"BBBA": 1, "BBAB": -3, "BABB": 3, "ABBB": -1}
    rows = [np.zeros(len(WORDS))]
    for before in range(degree - 3):
        for rest in itertools.product("AB", repeat=degree - 4):
            row = np.zeros(len(WORDS))
            for word, factor in relation.items():
                row[INDEX[*rest[:before], *word, *rest[before:]]] += factor
            rows.append(row)
    chosen = [INDEX[word] for word in WORDS if len(word) == degree]
    _, sizes, basis = np.linalg.svd(np.array(rows)[:, chosen])
    left = np.zeros((len(WORDS), len(chosen) - np.sum(sizes > 1e-9)))
    left[chosen] = basis[np.sum(sizes > 1e-9) :].T
    return jnp.array(left)


LEFT = {degree: _modulo_nystroem(degree) for degree in (3, 5, 7)}


def words(moves, kick_first):
    """The errors of the coefficients of all words."""
    powers = jnp.arange(DEGREE + 1)
    first, second = ("B", "A") if kick_first else ("A", "B")

    def move(vector, lengths):
        for letter, length in zip((first, second), lengths, strict=True):
            vector = jnp.einsum("k,i,kij->j", length**powers, vector, APPEND[letter])
        return vector, None

    start = jnp.zeros(len(WORDS)).at[0].set(1)
    pairs = jnp.append(moves, 0.0).reshape(-1, 2)
    return jax.lax.scan(move, start, pairs)[0] - FLOW


# Symmetric splittings by their independent coefficients, and the search among them.


def splitting(x):
    """Alternating kicks and drifts, kicks first, that sum to one each."""
    kicks, drifts = x[: STAGES // 2], x[STAGES // 2 :]
    middle = 1 - 2 * jnp.sum(kicks, keepdims=True)
    last = 0.5 - jnp.sum(drifts, keepdims=True)
    kicks = jnp.concatenate([kicks, middle, kicks[::-1]])
    drifts = jnp.concatenate([drifts, last, last, drifts[::-1]])
    return jnp.append(jnp.stack([kicks[:-1], drifts], 1).ravel(), kicks[-1])


def coefficients(moves):
    kicks, drifts = moves[0::2], moves[1::2]
    return np.array([*kicks[: STAGES // 2], *drifts[: STAGES // 2 - 1]], float)


def nystroem_problem(longest=4.0, weight=1e-3):
    z = jnp.array(frequencies(longest))

    def conditions(x):
        errors = words(splitting(x), True)
        each = [errors @ LEFT[n] * math.factorial(n) for n in (3, 5)]
        return jnp.concatenate(each)

    def objective(x):
        linear = oscillator(splitting(x), True, z) / (z / longest) ** 7
        any_force = weight * (STAGES / 3) ** 7 * (words(splitting(x), True) @ LEFT[7])
        return jnp.concatenate([linear.ravel(), any_force])

    return Problem(conditions, objective)


def linear_splittings(random):
    """Splittings for oscillators, found from random starts, without end."""
    problem, mpmath.mp.dps = LinearProblem(), 50
    while True:
        x, residual = problem.minimise(problem.start(random), 400)
        if x is None:
            continue
        polynomials = problem.sharpen(x)
        if polynomials is None:
            continue
        moves = euclid(*polynomials)
        # Much longer moves would let errors other than an oscillator's grow.
        if np.sum(np.abs(moves)) < 12:
            yield moves, residual


def nystroem_splittings(random):
    """Splittings of order 6, found from those for oscillators."""
    problem, found = nystroem_problem(), []
    for moves, _ in linear_splittings(random):
        for start in (coefficients(moves), *(x for _, x in found[:4])):
            size = random.choice([0, 0.02, 0.1, 0.25]) / STAGES
            noise = size * random.standard_normal(len(start))
            x, residual = problem.minimise(start + noise, 250)
            if x is not None:
                found.append((residual, x))
                yield np.asarray(splitting(x)), residual
        found = sorted(found, key=lambda pair: pair[0])[:8]


def describe(table, name, moves, kick_first):
    each = [reach(moves, kick_first, target) for target in (1e-3, 1e-6, 1e-9)]
    errors, stages = words(moves, kick_first), len(moves) // 2
    sizes = [jnp.linalg.norm(errors @ LEFT[n]) * stages ** (n - 1) for n in (3, 5, 7)]
    table.row(name, *each, *(float(x) if x > 1e-9 else None for x in sizes))


def main():
    parser = command_line(__doc__)
    parser.add_argument("--search", choices=["linear", "rkn"])
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    titles = ("1e-3", "1e-6", "1e-9", "h^3", "h^5", "h^7")
    table = Table("", ":<21", *(f"{title}:>7.3f" for title in titles))
    for name in SCHEMES + TUNED:
        tableau = getattr(dps, name).tableau
        describe(table, name, jnp.array(tableau.fractions), tableau.kick_first)
    if options.search is not None:
        search = {"linear": linear_splittings, "rkn": nystroem_splittings}
        random = np.random.default_rng(options.seed)
        best, start = math.inf, time.monotonic()
        for moves, residual in search[options.search](random):
            if residual < best:
                best = residual
                describe(table, f"found, {residual:.1e}", jnp.array(moves), True)
                print("  ", *(f"{x:.17g}" for x in moves[: STAGES + 1]))
            if time.monotonic() - start > options.seconds:
                break
    elif not options.quick:
        problem = nystroem_problem()
        x = coefficients(np.array(dps.TunedRKN6.tableau.fractions))
        before = np.linalg.norm(problem.objective(x))
        _, after = problem.minimise(np.round(x, 3), 600)
        print(f"Objective of TunedRKN6: {before:.4g}, from three digits: {after:.4g}")


if __name__ == "__main__":
    main()
