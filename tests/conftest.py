import jax
import pytest


# Double precision, as properties are tested to rounding; strict promotion, as a silent
# promotion would make a `float32` solve slow.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

pytest.register_assert_rewrite("helpers")
