"""The table of orders in `docs/friction.md`, as the catalogue claims them:
`python tests/orders.py` prints it. `test_pairs.py` tests the claims, and the table.
"""

import catalogue
from catalogue import claim, fails, Refused


def cell(scheme, friction) -> str:
    """The orders over all systems that take the friction; `p` is that of the scheme."""
    bare, claims = catalogue.WRAPPERS[0], set()
    for system in catalogue.SYSTEMS:
        order = claim(system, friction, scheme)
        if not isinstance(order, Refused) and not fails(
            *(system, friction, scheme, bare)
        ):
            claims.add("p" if order == scheme.order else f"{order:g}")
    return " or ".join(sorted(claims)) or "–"


def merged(rows: dict) -> dict:
    """Rows of the same entries as one."""
    names: dict = {}
    for name, row in rows.items():
        names.setdefault(tuple(row), []).append(name)
    return {"<br>".join(group): row for row, group in names.items()}


def table() -> str:
    both = catalogue.SCHEMES, catalogue.FRICTION
    schemes, laws = ([x for x in xs if "own" not in x.name] for xs in both)
    columns = merged({s.name: [cell(s, law) for law in laws] for s in schemes})
    cells = zip(*columns.values(), strict=True)
    rows = merged({law.name: row for law, row in zip(laws, cells, strict=True)})
    lines = [["friction", *columns], ["---"] * (1 + len(columns))]
    lines += [[name, *row] for name, row in rows.items()]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    print(table())
