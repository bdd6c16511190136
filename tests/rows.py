# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
"""Rows of the catalogue: one entry of each list, so that each pair is in some row."""

import itertools
import os
import random
from functools import cache

import catalogue
from catalogue import claim, Refused


FACTORS = {
    "scheme": catalogue.SCHEMES,
    "friction": catalogue.FRICTION,
    "system": catalogue.SYSTEMS,
    "way": catalogue.WAYS,
    "gradient": catalogue.GRADIENTS,
    "wrapper": catalogue.WRAPPERS,
    "precision": catalogue.PRECISIONS,
}


def possible(row: dict) -> bool:
    """Whether some entries can be tried together. What is refused is tried apart, since
    a row of it would test none of its other pairs."""
    scheme, friction, way = (row.get(k) for k in ("scheme", "friction", "way"))
    if "system" in row and isinstance(claim(row["system"], friction, scheme), Refused):
        return False
    if "system" in row and row["system"].react and friction.limit is not None:
        return False  # a push that infinite friction stops has no effect
    composes = "wrapper" in row and row["wrapper"].composes
    if composes and not scheme.composable:
        return False
    if "system" in row and row["system"].slow and (composes or scheme.order > 2):
        return False
    if way is not None and way.backwards and friction.limit is not None:
        return False
    jumps = "system" in row and row["system"].jumps
    uneven = way is not None and (way.name == "step density" or way.between)
    if (jumps or uneven) and "multistep" in scheme.name:
        return False  # its history is of equal steps
    if jumps and way is not None and not way.between:
        return False  # a step across a jump is of order one
    if way is not None and way.name == "HalfSolver" and scheme.name == "Tao":
        return False  # its docstring says why
    if row.get("precision") == "float32" and friction.double:
        return False
    return "gradient" not in row or way.own == row["gradient"].own


def pairs(row: dict) -> set[str]:
    names = [f"{factor}: {entry}" for factor, entry in row.items()]
    return set(map(" and ".join, itertools.combinations(sorted(names), 2)))


@cache
def covering() -> list[dict]:
    """Rows that have all possible pairs: greedily, entry by entry.

    (The greedy algorithm of allpairspy loses pairs to conditions such as these.)
    """
    rng = random.Random(0)
    seen = set()

    def complete(row: dict) -> dict:
        for name, entries in FACTORS.items():
            if name not in row:
                options = [row | {name: x} for x in entries]
                options = [x for x in options if possible(x)]
                rng.shuffle(options)
                row = max(options, key=lambda x: len(pairs(x) - seen))
        seen.update(pairs(row))
        return {name: row[name] for name in FACTORS}

    table = []
    for scheme, friction in itertools.product(*list(FACTORS.values())[:2]):
        row = {"scheme": scheme, "friction": friction}
        if any(possible(row | {"system": x}) for x in catalogue.SYSTEMS):
            table.append(complete(row))
    # The other pairs. Of systems each scheme and each friction takes only some.
    triples = itertools.product(*list(FACTORS.values())[:3])
    triples = [dict(zip(FACTORS, x, strict=False)) for x in triples]
    triples = list(filter(possible, triples))
    rng.shuffle(triples)
    for names in itertools.combinations(FACTORS, 2):
        for entries in itertools.product(*(FACTORS[name] for name in names)):
            pair = dict(zip(names, entries, strict=True))
            if pairs(pair) <= seen:
                continue
            rows = (x | pair for x in triples if (x | pair).items() >= x.items())
            row = next(filter(possible, rows), None)
            if row is not None:
                table.append(complete(row))
    return table


# The number of rows, and entries that they all have.
SAMPLE = int(os.environ.get("ROWS", 4))
ENTRIES = set(os.environ.get("ENTRIES", "").split("|")) - {""}


def sample() -> list[dict]:
    """Some rows that have as many entries as possible."""
    rest = [x for x in covering() if {*map(str, x.values())} >= ENTRIES]
    # Constraints take long to compile: they are tried slowly, or if they are asked for.
    quick = [x for x in rest if not x["system"].constrained]
    rest = quick or rest
    random.Random(0).shuffle(rest)
    entries = lambda row: set(map(str, row.items()))
    chosen, seen = [], set()
    for _ in range(min(SAMPLE, len(rest))):
        row = max(rest, key=lambda row: len(entries(row) - seen))
        seen = seen | entries(row) if entries(row) - seen else entries(row)
        rest.remove(row)
        chosen.append(row)
    return chosen
