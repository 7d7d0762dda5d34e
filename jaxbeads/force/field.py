"""A user's function of time and position as force or potential, without a class of its own."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._functions import leaf_function, trial, value_of
from ..chain import Chain
from ..setting import Setting
from ..state import Load, State
from .base import AbstractForce, AbstractPotential


class ForceField(AbstractForce):
    """F = f(t, r) from a function of the time and all positions, `(beads, dim)`, that returns forces
    of the same shape. A function that is a pytree (an `equinox.Module`) keeps its parameters as
    leaves; what a plain function closes over is constant. `links`: whether it keeps neighbours
    together.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import ForceField
    >>> push = ForceField(lambda t, r: jnp.zeros_like(r).at[:, 0].set(jnp.cos(t)))
    >>> setting = jb.Setting(jb.Chain(radius=1.0, fibres=2), viscosity=1.0)
    >>> print(push.load(jnp.zeros(()), jb.State([[0.0, 0.0], [2.0, 0.0]]), setting).force)
    [[1. 0.]
     [1. 0.]]
    """

    rotational: ClassVar[bool] = False
    function: Callable[[Array, Array], Array] = eqx.field(converter=leaf_function)
    links: bool = eqx.field(static=True, default=False, kw_only=True)

    def check(self, chain: Chain, dim: int) -> None:
        """A force for each bead."""
        _check(self, chain, dim)

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """The function's value as forces."""
        return Load(force=_value(self, t, state.position, state.position.shape))


class Potential(AbstractPotential):
    """E = f(t, r) from a function of the time and all positions, `(beads, dim)`, that returns an
    energy; the force is minus its gradient. Leaves and `links` as in `ForceField`.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import Potential
    >>> trap = Potential(lambda t, r: 0.5 * jnp.sum(r**2))
    >>> setting = jb.Setting(jb.Chain(radius=1.0, fibres=1), viscosity=1.0)
    >>> print(trap.load(jnp.zeros(()), jb.State([[3.0, 1.0]]), setting).force)
    [[-3. -1.]]
    """

    rotational: ClassVar[bool] = False
    function: Callable[[Array, Array], Array] = eqx.field(converter=leaf_function)
    links: bool = eqx.field(static=True, default=False, kw_only=True)

    def check(self, chain: Chain, dim: int) -> None:
        """One energy, with a gradient."""
        _check(self, chain, dim)

    def energy(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, ""]:
        """The function's value."""
        return _value(self, t, state.position, ())


def _value(
    field: ForceField | Potential, t: Array, position: Array, shape: tuple[int, ...]
) -> Array:
    name, given = f"{type(field).__name__}.function", f"a time and {len(position)} positions"
    dtype = position.dtype
    arguments = jnp.asarray(t, dtype), position
    return value_of(name, given, field.function, *arguments, shapes=(shape,), dtype=dtype)


def _check(field: ForceField | Potential, chain: Chain, dim: int) -> None:
    t, r = (jnp.zeros(shape, chain.radius.dtype) for shape in ((), (chain.beads, dim)))
    scene = Setting(chain, 1.0)
    trial(lambda t, r: field.load(t, State(r), scene), t, r)
