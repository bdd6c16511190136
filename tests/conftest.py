import re

import jax
import pytest


# Double precision, as properties are tested to rounding; strict promotion, as a silent
# promotion would make a `float32` solve slow.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

pytest.register_assert_rewrite("helpers")

# The slowest of several similar tests, by `pytest --durations`. They are marked slow,
# as are those with the marker in their own file.
SLOW = re.compile(
    "|".join(
        [
            r"test_docs.*docs/tutorials/",
            r"test_tuned.*(gradients_by_reversal|wrappers_around)",
            r"test_adjoint.*all_that_is_saved\[(subs|ts-steps|t0-t1)",
            r"test_adjoint.*what_damping_forgets\[10",
            r"test_adjoint.*computed_numbers\[(tao|suzuki_yoshida_4|euler_A)",
            r"test_adjoint.*found_again_to_rounding\[0.0-1.0-0.1",
            r"test_events.*solver_state_belongs\[(Tao|splitting)",
            r"test_events.*some_have_an_event",
            r"test_gradients.*test_gradients\[(suzuki_yoshida_4|tao|euler_B)",
            r"test_gradients.*without_damping",
            r"test_float32.*agrees_with_float64\[tao_4",
            r"test_step_density.*(it_should|gradients_through_the_steps)",
            r"test_diffeqsolve.*any_pytrees\[(tao_4|coupled_4)",
            r"test_friction.*from_rest\[(TunedRKN6|PresymplecticLeapfrog-mixed)",
            r"test_gauss.*test_order\[(2|4)\]",
            r"test_gauss.*of_order_stages_plus_two",
            r"test_gauss.*(joint_coordinates\[friction2|rounding_does_not_drift)",
            r"test_wrappers.*undoes_a_step.*(other|checked|compensated)",
            r"test_structure.*undoes_a_step\[tao_fixed",
            r"test_bregman.*leaving_the_domain",
            r"test_nonseparable.*(do_not_grow|at_equal_cost)",
            r"test_tableaus.*that_are_not_quadratic",
            r"test_vmap.*everything_at_once\[coupled_4",
            r"test_gauss.*those_of_the_energy\[(2|6)",
            r"test_multistep.*test_order\[(10|8-(mixed|function|excitation))",
            r"test_multistep.*(checkpoints\[logarithmic|at_steps\[mixed|drift\[1)",
            r"test_multistep.*(finite_differences|backwards_in_time)",
            r"test_diffeqsolve.*any_pytrees\[leapfrog_BA",
            r"test_hard_cases.*(ensemble_of_chaos|no_overflow_of_the_frame)",
            r"test_step_density.*can_be_continued",
            r"test_choose_step.*(is_reached\[(irregular|orbit)|twice_as_many)",
        ]
    )
)


def pytest_collection_modifyitems(items):
    for item in items:
        if SLOW.search(item.nodeid):
            item.add_marker(pytest.mark.slow)
