import gc
import zlib

import jax
import pytest


# Double precision, as properties are tested to rounding; strict promotion, as a silent
# promotion would make a `float32` solve slow.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

pytest.register_assert_rewrite("helpers", "errors")

# Traced programs are many small objects, which Python would count again and again.
gc.set_threshold(100_000, 20, 50)


@pytest.fixture(scope="module", autouse=True)
def _memory():
    """Compiled programs are dropped after each module, or they take gigabytes."""
    yield
    jax.clear_caches()


# Of each test with more parameters than these, a sample is run by `make test`, and all
# by `make slow`. `@pytest.mark.variants(n)` changes it. The sample is the same for all
# commits, so that a test fails by what is changed alone.
VARIANTS = 2


def pytest_addoption(parser):
    parser.addoption("--part", help="the k-th of n parts of the tests, as k/n")


def pytest_collection_modifyitems(config, items):
    tests: dict = {}
    for item in items:
        tests.setdefault(item.nodeid.split("[")[0], []).append(item)
    rank = lambda item: zlib.crc32(item.nodeid.encode())
    for first, *others in tests.values():
        marker = first.get_closest_marker("variants")
        number = VARIANTS if marker is None else marker.args[0]
        for item in sorted(others, key=rank)[number - 1 :]:
            item.add_marker(pytest.mark.slow)
    if config.getoption("part"):
        part, parts = map(int, config.getoption("part").split("/"))
        # Not Python's hash, which differs between the processes.
        own = lambda item: zlib.crc32(item.nodeid.encode()) % parts == part % parts
        config.hook.pytest_deselected(items=[x for x in items if not own(x)])
        items[:] = filter(own, items)


def pytest_terminal_summary(terminalreporter):
    """How many pairs of entries of the catalogue were tried, and how many refused."""
    reports = terminalreporter.getreports("passed")
    properties = [x for report in reports for x in report.user_properties]
    rows = [value for name, value in properties if name == "pairs"]
    refused = sum(value for name, value in properties if name == "refused")
    pairs = len(set().union(*rows))
    terminalreporter.write_line(
        f"{len(rows)} rows of {pairs} pairs of entries of the catalogue are right, "
        f"{refused} combinations are refused"
    )
