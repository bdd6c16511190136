"""What is private in Diffrax and used here: its state, and how it is saved.

`tests/test_diffrax_contract.py` has a test for each of them.
"""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree


def flatten_subs(saveat: dfx.SaveAt) -> tuple[list[dfx.SubSaveAt], Any]:
    """All of `SaveAt(subs=...)`, and the structure that they are in."""
    is_sub = lambda x: isinstance(x, dfx.SubSaveAt)
    return jtu.tree_flatten(saveat.subs, is_leaf=is_sub)


def start_of(state) -> tuple[PyTree, PyTree, Any, PyTree, PyTree]:
    """The initial state and solver state, whether that is stale, and the states of the
    progress meter and the controller."""
    meter, control = state.progress_meter_state, state.controller_state
    return state.y, state.solver_state, state.made_jump, meter, control


def saved_buffers(state, structure) -> list[tuple[Array, PyTree]]:
    """The times and values to fill of each of `SaveAt(subs=...)`."""
    return [(save.ts, save.ys) for save in structure.flatten_up_to(state.save_state)]


def final_state(
    state,
    structure,
    *,
    y: PyTree,
    solver_state: PyTree,
    t: Array,
    steps: Array,
    result: dfx.RESULTS,
    meter: PyTree,
    saved: list[tuple[Array, PyTree, Array, Array]],
    control: PyTree | None = None,
):
    """Diffrax's state at the end of a solve of so many `steps`, from that at its start.

    `saved` has the times, the values, the number of rows and the number of times of
    `ts` of each output; `control` is the state of the controller, if that is more than
    a count of steps.
    """
    saves = [
        eqx.tree_at(
            lambda x: (x.ts, x.ys, x.save_index, x.saveat_ts_index), save, values
        )
        for save, values in zip(
            structure.flatten_up_to(state.save_state), saved, strict=True
        )
    ]
    # The first of the numbers of a controller counts the steps.
    count, *rest = jtu.tree_leaves(state.controller_state)
    count = count + jnp.asarray(steps, jnp.result_type(count))
    controller = jtu.tree_unflatten(
        jtu.tree_structure(state.controller_state), [count, *rest]
    )
    new = {
        "y": y,
        "solver_state": solver_state,
        "tprev": t,
        "num_steps": steps,
        "num_accepted_steps": steps,
        "result": result,
        "progress_meter_state": meter,
        "save_state": jtu.tree_unflatten(structure, saves),
        "controller_state": controller if control is None else control,
        "made_jump": False,
    }
    where = lambda x: [getattr(x, name) for name in new]
    return eqx.tree_at(where, state, list(new.values()), is_leaf=lambda x: x is None)
