import gc
import zlib

import jax
import pytest


# Double precision, as properties are tested to rounding; strict promotion, as a silent
# promotion would make a `float32` solve slow.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

pytest.register_assert_rewrite("helpers")

# Traced programs are many small objects, which Python would count again and again.
gc.set_threshold(100_000, 20, 50)


@pytest.fixture(scope="module", autouse=True)
def _memory():
    """Compiled programs are dropped after each module, or they take gigabytes."""
    yield
    jax.clear_caches()


def pytest_addoption(parser):
    parser.addoption("--part", help="the k-th of n parts of the tests, as k/n")


def pytest_collection_modifyitems(config, items):
    if config.getoption("part"):
        part, parts = map(int, config.getoption("part").split("/"))
        # Not Python's hash, which differs between the processes.
        own = lambda item: zlib.crc32(item.nodeid.encode()) % parts == part % parts
        config.hook.pytest_deselected(items=[x for x in items if not own(x)])
        items[:] = filter(own, items)
