"""The code of the documentation runs, and all public names are documented."""

import inspect
import pathlib
import pydoc
import re
import runpy

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx
import pytest

import diffrax_presym as dps


ROOT = pathlib.Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
SCRIPT = runpy.run_path(str(ROOT / "docs" / "_tutorials.py"))
FENCE, python_blocks = SCRIPT["FENCE"], SCRIPT["python_blocks"]
FIGURES = SCRIPT["pages_with_figures"]()
PUBLIC = {
    name: value
    for name, value in vars(dps).items()
    if not name.startswith("_") and not inspect.ismodule(value)
}
PUBLIC |= {
    f"diagnostics.{name}": value
    for name, value in vars(dps.diagnostics).items()
    if not name.startswith("_") and ".diagnostics." in getattr(value, "__module__", "")
}
PUBLIC |= {
    f"extend.{name}": value
    for name, value in vars(dps.extend).items()
    if not name.startswith("_")
}
REFERENCE = re.compile(
    r"\[`?(diffrax_presym\.[\w.]+)`?\]\[|\]\[(diffrax_presym\.[\w.]+)\]"
)


def docstrings(value):
    """The docstrings of an object and of its own members."""
    members = vars(value).values() if inspect.isclass(value) else ()
    objects = [value, *(x for x in members if callable(x) or isinstance(x, property))]
    return [inspect.getdoc(x) or "" for x in objects]


@pytest.fixture
def as_user(tmp_path, monkeypatch):
    """JAX with its default settings, and a directory for figures."""
    settings = {
        "jax_enable_x64": False,
        "jax_numpy_dtype_promotion": "standard",
        "jax_numpy_rank_promotion": "allow",
    }
    before = {name: getattr(jax.config, name) for name in settings}
    backend = matplotlib.get_backend()
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("Agg")
    for name, value in settings.items():
        jax.config.update(name, value)
    yield
    plt.close("all")
    plt.switch_backend(backend)
    for name, value in before.items():
        jax.config.update(name, value)


def run(blocks, name, namespace):
    for number, block in enumerate(blocks, 1):
        exec(compile(block, f"{name}, block {number}", "exec"), namespace)


# `plt.show()` warns that the backend is not interactive.
@pytest.mark.filterwarnings("ignore:.*is non-interactive:UserWarning")
@pytest.mark.parametrize("page", PAGES, ids=lambda x: str(x.relative_to(ROOT)))
def test_page_runs(page, as_user):
    run(python_blocks(page.read_text()), page.name, {"__name__": "__main__"})


@pytest.mark.parametrize("name", PUBLIC)
def test_docstring_runs(name, as_user):
    blocks = [x for doc in docstrings(PUBLIC[name]) for x in python_blocks(doc)]
    # Docstrings omit the usual imports.
    usual = {"dfx": dfx, "dps": dps, "eqx": eqx, "jax": jax, "jnp": jnp, "np": np}
    run(blocks, name, {**vars(dfx), **PUBLIC, **usual, "optx": optx})


def example(value):
    """The names that the examples of a docstring define."""
    names = {**vars(dfx), **PUBLIC, "jnp": jnp, "dfx": dfx, "dps": dps}
    run([x for doc in docstrings(value) for x in python_blocks(doc)], "", names)
    return names


def test_signs_of_the_examples():
    # Forces of a magnetic field and of a rotating frame, on a velocity.
    v, x = jnp.array([0.3, -0.7, 0.5]), example(dps.ViscousDamping)
    force = lambda law: law.force(0.0, v, x["m"] * v, v, None)
    magnetic = x["e"] * np.cross(v, x["B"])
    np.testing.assert_allclose(force(x["magnetic"]), magnetic, rtol=1e-6)
    coriolis = -2 * x["m"] * np.cross(x["Omega"], v)
    np.testing.assert_allclose(force(x["coriolis"]), coriolis, rtol=1e-6)
    # Gravity attracts.
    system = example(dps.pairwise_potential)["system"]
    q = jnp.array([[0.0, 0.0], [1.0, 0.0], [4.0, 0.0]])
    assert system.force(0.0, q, 0 * q)[0, 0] > 0
    # Links hang down, a shaft is bent back, and both lose energy.
    for value, n in ((dps.LagrangianSystem, 2), (dps.MechanicalSystem, 3)):
        system, q = example(value)["system"], jnp.full(n, 0.1)
        assert np.all(system.force(0.0, q, 0 * q)[0] < 0)
        p = jnp.arange(1.0, n + 1)
        assert system.friction_force(0.0, q, p) @ system.velocity(0.0, q, p) < 0


@pytest.mark.variants(1000)
@pytest.mark.parametrize("page", PAGES, ids=lambda x: str(x.relative_to(ROOT)))
def test_blocks_say_their_language_and_fit_the_page(page):
    # In a window of 1280 pixels. The letters of folded blocks are smaller.
    for block in FENCE.finditer(page.read_text()):
        assert block["language"] in {"bash", "bibtex", "python", "sh", "text"}
        indent = len(block["indent"])
        longest = max(map(len, block["code"].splitlines()), default=0) - indent
        assert longest <= (110 if indent else 100), block[0]


def test_pages_with_figures_have_names_of_their_own():
    assert len({page.stem for page in FIGURES}) == len(FIGURES)


@pytest.mark.variants(1000)
@pytest.mark.parametrize("page", FIGURES, ids=lambda x: x.stem)
def test_pages_draw_the_pictures_they_show(page):
    text = page.read_text()
    shown = re.findall(r"!\[[^\]]+\]\(\.\./img/([^)]+)\)", text)
    code = "\n".join(python_blocks(text))
    assert all((ROOT / "docs" / "img" / name).is_file() for name in shown)
    # Those of scripts that need other libraries are named after their script.
    scripts = {x.stem for x in (ROOT / "examples" / "clients").glob("*.py")}
    shown = [x for x in shown if pathlib.Path(x).stem not in scripts]
    assert shown == re.findall(r"savefig\(\"([^\"]+)\"", code)
    assert shown == [FIGURES[page]]


def test_recipes_for_other_libraries_are_those_of_the_examples():
    names = ("clients", "sampling", "small_recipes")
    pages = (ROOT / "docs" / "howto" / f"{x}.md" for x in names)
    blocks = [x["code"] for page in pages for x in FENCE.finditer(page.read_text())]
    recipes = [x for x in blocks if x.startswith(("# examples/", "# benchmarks/"))]
    clients = list((ROOT / "examples" / "clients").glob("[!_]*.py"))
    assert len(recipes) == len(clients) + 3
    for recipe in recipes:
        first, code = recipe.split("\n", 1)
        assert code in (ROOT / first[2:].split(",")[0]).read_text()


def test_every_public_name_is_in_the_api():
    api = "\n".join(x.read_text() for x in (ROOT / "docs" / "api").glob("*.md"))
    shown = re.findall(r"^::: diffrax_presym\.([\w.]+)$", api, re.MULTILINE)
    assert len(shown) == len(set(shown))
    assert set(shown) == set(PUBLIC)


@pytest.mark.variants(1000)
@pytest.mark.parametrize("name", PUBLIC)
def test_docstring_is_complete(name):
    value = PUBLIC[name]
    doc = inspect.getdoc(value)
    assert doc and doc.splitlines()[0]
    assert value.__doc__, "inherited, not its own"
    if not inspect.isclass(value):
        assert "**Arguments:**" in doc
        return
    if issubclass(value, dps.extend.AbstractPresymplecticSolver) and value is not (
        dps.extend.AbstractPresymplecticSolver
    ):
        assert re.search(r"\border\b|\bcost per step\b", doc, re.IGNORECASE)
        assert "dense/ts output" in doc.replace("\n", " ").lower()
    # Every argument of a public constructor is documented.
    if inspect.isabstract(value) or name in DOCUMENTED_AS_A_WHOLE:
        return
    arguments = list(inspect.signature(value).parameters)
    explained = (value.__init__.__doc__ or "").replace("\n", " ")
    if arguments:
        assert "**Arguments:**" in explained
    for argument in arguments:
        assert f"`{argument}`" in explained, argument


# Records whose fields are documented in the class docstring; not created by users.
DOCUMENTED_AS_A_WHOLE = {
    "ChosenStep",
    "diagnostics.WorkPrecision",
    "diagnostics.WorkPrecisionRun",
    "extend.AbstractDamping",
    "extend.HermiteInterpolation",
    "extend.Mechanics",
    "extend.Parts",
    "extend.Scheme",
    "extend.Span",
    "extend.MoveSequence",
    "extend.System",
    "SplittingTableau",
}


def test_references_resolve():
    texts = {str(x.relative_to(ROOT)): x.read_text() for x in PAGES}
    texts |= {name: "\n".join(docstrings(value)) for name, value in PUBLIC.items()}
    for where, text in texts.items():
        for groups in REFERENCE.findall(text):
            name = "".join(groups).removeprefix("diffrax_presym.")
            assert name in PUBLIC, f"{where} refers to {name}"


@pytest.mark.variants(1000)
@pytest.mark.parametrize("name", PUBLIC)
def test_help_is_readable_in_a_terminal(name):
    value = PUBLIC[name]
    assert "Initialize self" not in pydoc.render_doc(value)
    # What is inherited from Diffrax is written for its own documentation.
    text, inherited = [], []
    for base in inspect.getmro(value) if inspect.isclass(value) else [value]:
        own = base.__module__.startswith("diffrax_presym")
        members = [base, *vars(base).values()]
        methods = [x for x in members if x is base or not inspect.isclass(x)]
        docs = [str(getattr(x, "__doc__", "")) for x in methods]
        (text if own else inherited).extend(docs)
    text = "\n".join(set(text) - set(inherited))
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    assert not re.search(r"\]\[|\$|\\[a-zA-Z]|<\w+>", text)
