"""The files for publication say the same as `pyproject.toml`."""

import pathlib
import re
import tomllib

import pytest

import diffrax_presym as dps


ROOT = pathlib.Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PROJECT["project"]


def text(*path):
    return ROOT.joinpath(*path).read_text(encoding="utf-8")


def yaml_list(source, key):
    """The items below a key of a YAML file, as strings."""
    (found,) = re.findall(rf"^ *{key}:\n((?: +- .*\n)+)", source, re.MULTILINE)
    return [x.strip().removeprefix("- ") for x in found.splitlines()]


def test_citation():
    citation = text("CITATION.cff")
    (author,) = PROJECT["authors"]
    for line in (
        f"title: {PROJECT['name']}",
        f"version: {dps.__version__}",
        f"license: {PROJECT['license']}",
    ):
        assert f"\n{line}\n" in citation
    assert f"\nauthors:\n  - name: {author['name']}\nreferences:" in citation


def test_conda_recipe():
    recipe = text("conda", "meta.yaml")
    python = f"python {PROJECT['requires-python']}"
    needs = {re.sub(r"(?=>)", " ", x, count=1) for x in PROJECT["dependencies"]}
    run, host = yaml_list(recipe, "run"), yaml_list(recipe, "host")
    assert len(run) == len(set(run))
    assert set(run) == {python, *needs}
    assert set(host) == {python, "hatchling", "pip"}
    assert f'set version = "{dps.__version__}"' in recipe
    assert f"\n  name: {PROJECT['name']}\n" in recipe
    assert f"\n  summary: {PROJECT['description']}\n" in recipe
    assert f"\n  license: {PROJECT['license']}\n" in recipe


def test_paper():
    _, head, body = text("paper", "paper.md").split("---\n", 2)
    (author,) = PROJECT["authors"]
    assert f"authors:\n  - name: {author['name']}\n" in head
    assert f'title: "{PROJECT["name"]}: ' in head
    # The least and the most words that the journal and two pages allow.
    assert 750 <= len(re.findall(r"\S*\w\S*", body)) <= 1000
    cited = set(re.findall(r"@([a-z_0-9]+)", body))
    assert cited == set(re.findall(r"@\w+\{(\w+),", text("paper", "paper.bib")))


@pytest.mark.parametrize(
    ("row", "nth"), [("final time", 0), ("201 saved times", 1)], ids=["final", "saved"]
)
def test_paper_has_the_numbers_of_the_benchmark(row, nth):
    test, _ = text("docs", "speed.md").split("## The tuning half")
    (found,) = re.findall(rf"^\| {row} +\|(.*)\|$", text("paper", "paper.md"), re.M)
    means = re.findall(r"^\| \*\*geometric mean\*\* \|(.*)\|$", test, re.M)[nth]
    least = re.findall(r"^\| \*\*least\*\* \|(.*)\|$", test, re.M)[nth]
    cells = [[x.strip(" *") for x in y.split("|")][:3] for y in (means, least)]
    assert [x.strip() for x in found.split("|")] == [
        f"{mean} ({low})" for mean, low in zip(*cells, strict=True)
    ]


@pytest.mark.parametrize("nth", [0, 1], ids=["final", "saved"])
def test_readme_has_the_numbers_of_the_benchmark(nth):
    test, _ = text("docs", "speed.md").split("## The tuning half")
    rows = re.findall(r"^\| (\**[^|*]+\**) \|([^a-z]+)\|$", test, re.M)
    times = {
        name.strip("* "): [x.strip(" *") for x in cells.split("|")][:3]
        for name, cells in rows[16 * nth : 16 * (nth + 1)]
    }
    mean, least = times.pop("geometric mean"), times.pop("least")
    assert len(times) == 14
    columns = [sorted(map(float, x)) for x in zip(*times.values(), strict=True)]
    assert [str(x[0]) for x in columns] == least
    ranges = [f"{x[0]} to {x[-1]}" for x in columns]
    table = re.findall(
        r"^\|[^|]*, mean \|.*\n\| its range \|.*$", text("README.md"), re.M
    )
    shown = [
        [x.strip() for x in line.split("|")[2:5]] for line in table[nth].split("\n")
    ]
    assert shown == [mean, ranges]
