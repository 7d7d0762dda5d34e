"""`vary`: a function of the numbers that one picks from a scene."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jaxtyping import PyTree

from ._checks import described, fail
from ._typing import float_array


class Varied:
    """A function of chosen numbers of a tree; see `vary`. For `jit` the rest of the tree is constant."""

    def __init__(
        self, function: Callable[..., Any], tree: PyTree, where: Callable[[PyTree], PyTree]
    ) -> None:
        self.function, self.tree, self.where = function, tree, where

    @property
    def start(self) -> PyTree:
        """The numbers that the tree holds now."""
        return self.where(self.tree)

    def __call__(self, values: PyTree, *arguments: Any) -> Any:
        """The function of the tree with these numbers in place of its own."""
        new = jax.tree.map(float_array, values)
        if jax.tree.structure(new) != jax.tree.structure(self.start):
            must = f"have the structure of what `where` picks, {jax.tree.structure(self.start)}"
            fail("values", must, f"it has {jax.tree.structure(new)}")
        return self.function(eqx.tree_at(self.where, self.tree, new), *arguments)


def vary(function: Callable[..., Any], tree: PyTree, where: Callable[[PyTree], PyTree]) -> Varied:
    """A function of some numbers of a scene, for gradients, sweeps and optimisation:

        drift = vary(objective, scene, lambda scene: scene.forces[0].rigidity)
        jax.grad(drift)(drift.start); jax.vmap(drift)(jnp.linspace(1, 10, 32))

    **Arguments**: `function` of a scene (or of any tree of parameters, and of further arguments);
    the scene; `where`: a function that picks one of its arrays, or a tuple or list of them.
    **Returns** a function of new values in the same structure; its `start` holds the present ones.
    **Raises** `ValueError` if anything but arrays of numbers is picked.

    >>> import jax
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import Weight
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[Weight([0.0, -6.0])])
    >>> def speed(scene):
    ...     return jb.observables.settling_velocity(0.0, jb.State([[0.0, 0.0]]), scene)[1]
    >>> of_viscosity = jb.vary(speed, scene, lambda scene: scene.viscosity)
    >>> print(of_viscosity.start, f"{of_viscosity(1.0):.4f}, {jax.grad(of_viscosity)(1.0):.4f}")
    1.0 -0.3183, 0.3183
    """
    for name, given in (("function", function), ("where", where)):
        if not callable(given):
            fail(name, "be a function", f"it is {described(given)}")
    for leaf in jax.tree.leaves(where(tree), is_leaf=lambda x: isinstance(x, eqx.Module)):
        if not eqx.is_inexact_array(leaf):
            fail("where", "pick arrays of numbers", f"it picks {described(leaf)}")
    return Varied(function, tree, where)
