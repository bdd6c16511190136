"""Link names of other projects to their documentation, once on a page.

A build needs no network, so the pages on which they are documented are listed here.
"""

from _api import CODE


KIDGER = "https://docs.kidger.site/{project}/api/{page}/#{project}.{name}"
JAX = "https://docs.jax.dev/en/latest/_autosummary/{project}.{name}.html"
PAGES = {
    "diffrax": {
        "adjoints": "BacksolveAdjoint ForwardMode RecursiveCheckpointAdjoint",
        "diffeqsolve": "diffeqsolve",
        "saveat": "SaveAt",
        "solution": "RESULTS Solution",
        "solvers/ode_solvers": "Dopri5 Dopri8 Euler Kvaerno5 SemiImplicitEuler Tsit5",
        "solvers/sde_solvers": "HalfSolver",
        "stepsize_controller": "ConstantStepSize PIDController StepTo",
        "terms": "ODETerm",
    },
    "equinox": {"transformations": "filter_jit"},
    "lineax": {
        "operators": "AbstractLinearOperator MatrixLinearOperator",
        "solvers": "Tridiagonal",
    },
    "optimistix": {
        "minimise": "BFGS minimise",
        "root_find": "Bisection Newton root_find",
    },
    "jax": {"": "custom_jvp devices grad jacfwd jit jvp lax.map lax.scan vmap"},
}
SHORT = {"diffrax": "dfx", "equinox": "eqx", "lineax": "lx", "optimistix": "optx"}


def urls():
    for project, pages in PAGES.items():
        pattern = JAX if project == "jax" else KIDGER
        for page, names in pages.items():
            for name in names.split():
                url = pattern.format(project=project, page=page, name=name)
                yield f"{project}.{name}", url
                if project in SHORT:
                    yield f"{SHORT[project]}.{name}", url
                if project == "diffrax":
                    yield name, url


URLS = dict(urls())


def on_page_content(content, **kwargs):
    linked = set()

    def link(match):
        url = URLS.get(match["name"])
        if url is None or url in linked:
            return match[0]
        linked.add(url)
        return f'<a href="{url}">{match[0]}</a>'

    return CODE.sub(link, content)
