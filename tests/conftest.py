import jax
import pytest


# Doubles, because the promises are made to rounding; strict, because a silent promotion
# is how a `float32` solve turns into a slow one.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

pytest.register_assert_rewrite("helpers")
