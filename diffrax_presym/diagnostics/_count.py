"""Force evaluations, counted while a solve runs."""

import contextlib
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from .._hamiltonian import AbstractHamiltonian


class Counter:
    """Counts how often a state that passed through it was used.

    A callback returns a zero that is added to the state. XLA removes it where the force
    is not used, as it removes the force itself.
    """

    def __init__(self):
        self.count, self._inside = 0, False

        def add(x: np.ndarray) -> np.ndarray:
            self.count += x.size  # Several at once under `vmap`.
            return np.zeros_like(x)

        @jax.custom_jvp
        def zero(x):
            shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
            return jax.pure_callback(add, shape, x, vmap_method="broadcast_all")

        # The derivative of a force counts as an evaluation.
        zero.defjvp(lambda x, dx: (zero(*x), jnp.zeros_like(dx[0])))
        self._zero = zero

    def through(self, q: PyTree) -> PyTree:
        leaves, treedef = jtu.tree_flatten(q)
        leaves[0] = leaves[0] + self._zero(jnp.ravel(leaves[0])[0])
        return jtu.tree_unflatten(treedef, leaves)

    @contextlib.contextmanager
    def once(self, q: PyTree):
        """The state for an evaluation, counted unless it is part of another."""
        outermost = not self._inside
        self._inside = True
        try:
            yield self.through(q) if outermost else q
        finally:
            self._inside = not outermost


FORCES = "force", "potential_force", "velocity_and_force"


def counted(hamiltonian: AbstractHamiltonian, counter: Counter) -> AbstractHamiltonian:
    """The same Hamiltonian, whose force evaluations are counted."""
    cls = type(hamiltonian)

    def method(name):
        evaluate = getattr(cls, name)

        def call(self, t, q, p, args=None):
            with counter.once(q) as q:
                return evaluate(self, t, q, p, args)

        return call

    methods = {name: method(name) for name in FORCES}
    metaclass: Any = type(cls)
    new = object.__new__(metaclass(f"Counted{cls.__name__}", (cls,), methods))
    for field in dataclasses.fields(hamiltonian):
        object.__setattr__(new, field.name, getattr(hamiltonian, field.name))
    return new
