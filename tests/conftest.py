import gc
import re
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


# The slowest of several similar tests, by `pytest --durations`. They are marked slow,
# as are those with the marker in their own file.
SLOW = re.compile(
    "|".join(
        [
            # Run by `make oldest` too. The README and the first page remain.
            r"test_docs.*page_runs.docs/(?!getting_started)",
            r"test_adjoint.*(a_solve_of_no_length|found_again_to_rounding.0.3)",
            r"test_adjoint.*(a_stale_solver_state|functions_of_the_term_close_over)",
            r"test_adjoint.*(gradients_of_a_batch|without_max_steps|have_another_adjoint)",
            r"test_adjoint.*(holds_an_array\[(jit|nested)|states_in_single_precision)",
            r"test_adjoint.*all_that_is_saved",
            r"test_adjoint.*computed_numbers\[(tao|suzuki_yoshida_4|euler_A)",
            r"test_adjoint.*found_again_to_rounding\[0.0-1.0-0.1",
            r"test_adjoint.*to_rounding.*float32",
            r"test_adjoint.*what_damping_forgets\[10",
            r"test_bregman.*(leaving_the_domain|form_contracts_with_the_scaling.own)",
            r"test_bregman.*like_exp_of_beta\[(c = 4|own)",
            r"test_bregman.*of_the_hamiltonian\[(simplex|p-norm|log|hyp|own inverse)",
            r"test_choose_step.*(single_precision|is_reached.grid)",
            r"test_choose_step.*is_reached\[(irregular|orbit|args|backwards|leapfrog)",
            r"test_choose_step.*twice_as_many",
            r"test_cost.*evaluations_per_step\[(euler_A|leapfrog_AB|suzuki|tao_(fixed|4))",
            r"test_dense.*(backwards_in_time|derivative_is_the|at_the_steps.BlanesMoan)",
            r"test_dense.*(every_scheme.(tao|suz)|empty_solve.*Tao)",
            r"test_dense.*every_scheme\[(Tao|Yoshida)",
            r"test_diagnostics.*of_the_solver.driven",
            r"test_diffeqsolve.*(ends_and_times|empty_span).*(BA|tao)",
            r"test_diffeqsolve.*(too_few_steps.tao|pytrees.suzuki|ends_and_times.suz)",
            r"test_diffeqsolve.*any_pytrees\[(tao_4|coupled_4|leapfrog_BA)",
            r"test_diffeqsolve.*given_times_agree\[(tao|coupled|suzuki)",
            r"test_docs.*docstring_runs.LagrangianSystem",
            r"test_errors.*backsolve_adjoint",
            r"test_errors.*not_found_are_(a_result|an_error)\[(suzuki|euler_B|leapfrog_BA)",
            r"test_events.*(nothing_is_saved_after|events_backwards_in_time)",
            r"test_events.*(some_have_an_event|direction_of_an_event.False|which_event)",
            r"test_events.*restart_from_the_state",
            r"test_events.*solver_state_belongs",
            r"test_float32.*agrees_with_float64.leapfrog_AB",
            r"test_float32.*agrees_with_float64\[tao_4",
            r"test_float32.*no_overflow_in_other_systems\[.*(tao|coupled|yoshida)",
            r"test_friction.*from_rest\[(TunedRKN6|PresymplecticLeapfrog-mixed)",
            r"test_friction.*gradient_from_rest",
            r"test_friction.*output_from_rest.*power",
            r"test_friction.*output_from_rest\[PresymplecticLeapfrog-none",
            r"test_gauss.*(joint_coordinates\[friction2|rounding_does_not_drift)",
            r"test_gauss.*(mass_matrix_is_a_result.ind|to_rounding\[8)",
            r"test_gauss.*(of_order_stages_plus_two|the_implicit_function|dense_output)",
            r"test_gauss.*(those_of_the_energy\[(2|6)|symmetric_to_rounding.4)",
            r"test_gauss.*test_order\[(2|4)\]",
            r"test_gauss.*to_rounding\[1\]",
            r"test_gradients.*(without_damping|of_dense_output)",
            r"test_gradients.*test_gradients\[(suzuki_yoshida_4|tao|euler_B)",
            r"test_hamiltonians.*pairwise_potential",
            r"test_hard_cases.*(bounces|diverging_root_finder)",
            r"test_hard_cases.*(damping_by_pieces|stages_before_the_start)",
            r"test_hard_cases.*(ensemble_of_chaos|no_overflow_of_the_frame)",
            r"test_hard_cases.*from_its_start\[(suzuki|RKN4).0",
            r"test_loop.*(infinite_at_the_start|nothing_but_states|whatever_is_saved.1)",
            r"test_loop.*(zero_length.2|too_many_steps)",
            r"test_loop.*prescribed_steps",
            r"test_loop.*zero_length.0.3-2.5",
            r"test_mechanical.*(copies_that_part|balance.sum|order.place and matrix)",
            r"test_mechanical.*(friction_by_place_contracts|trace_by_hand|wrappers.drag)",
            r"test_mechanical.*(power_lost|vmap_over_coefficients)",
            r"test_mechanical.*(saved_times_and_steps|any_force|energy_balance.all)",
            r"test_mechanical.*test_(order|events)\[(matrix|drag)",
            r"test_multistep.*(checkpoints\[logarithmic|at_steps|drift\[1|float32)",
            r"test_multistep.*(does_not_drift.8|change_of_the_step_starts)",
            r"test_multistep.*(finite_differences|backwards_in_time|vmap|a_jump_starts)",
            r"test_multistep.*(first_steps_after_a_singularity|test_wrappers)",
            r"test_multistep.*test_order\[(10|8-(mixed|function|excitation))",
            r"test_nonseparable.*(do_not_grow|at_equal_cost|conformal.solver0|zero.*.2.)",
            r"test_order.*errors_are_those_of_the_reference.*(decaying|euler_A|_6)",
            r"test_order.*quadratic_kinetic_energies\[(tao|coupled|suzuki)",
            r"test_stages.*written_out",
            r"test_step_density.*(it_should|gradients_through|can_be_continued)",
            r"test_structure.*any_kinetic_energy\[(tao|coupled|suzuki)",
            r"test_structure.*undoes_a_step\[tao_fixed",
            r"test_structure.*with_the_damping.*(none|exciting|callable|-constant)",
            r"test_tableaus.*(that_are_not_quadratic|depend_on_time.*pendulum)",
            r"test_tuned.*(gradients_by_reversal|wrappers_around|friction.log)",
            r"test_vmap.*everything_at_once\[coupled_4",
            r"test_work_precision.*(all_solvers|are_left_out|forces\[term[13])",
            r"test_work_precision.*forces.term4",
            r"test_work_precision.*is_that_of_the_solve",
            r"test_wrappers.*(distance_of_copies|a_wrapped_step.*coupled)",
            r"test_wrappers.*a_wrapped_step.*(euler_A|leapfrog_AB|_4_BA|_8|tao(_fixed)?-)",
            r"test_wrappers.*by_reversal_through_wrappers.Suzuki4",
            r"test_wrappers.*schemes_for_any_energy\[(tao_|euler_A|leapfrog_AB|suzuki)",
            r"test_wrappers.*undoes_a_step.*(other|checked|compensated)",
        ]
    )
)


def pytest_addoption(parser):
    parser.addoption("--part", help="the k-th of n parts of the tests, as k/n")


def pytest_collection_modifyitems(config, items):
    for item in items:
        if SLOW.search(item.nodeid):
            item.add_marker(pytest.mark.slow)
    if config.getoption("part"):
        part, parts = map(int, config.getoption("part").split("/"))
        # Not Python's hash, which differs between the processes.
        own = lambda item: zlib.crc32(item.nodeid.encode()) % parts == part % parts
        config.hook.pytest_deselected(items=[x for x in items if not own(x)])
        items[:] = filter(own, items)
