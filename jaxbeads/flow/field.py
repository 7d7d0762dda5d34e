"""A user's velocity field, without a class of its own."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._functions import leaf_function, trial, value_of
from .base import AbstractFlow


class VelocityField(AbstractFlow):
    """u = f(t, x) from a function of the time and one point, shape `(dim,)`.

    Spin, rate of strain and what a sphere of finite radius feels of a curved field, (1 + a^2/6 lap) u,
    follow by differentiation, so the function needs derivatives up to the third (the fourth for implicit
    solvers). A function that is a pytree (an
    `equinox.Module`) keeps its parameters as leaves; what a plain function closes over is constant.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.flow import VelocityField
    >>> wave = VelocityField(lambda t, x: jnp.stack([jnp.sin(x[1]), 0.0 * x[1]]))
    >>> print(wave.velocity(jnp.zeros(()), jnp.array([0.0, jnp.pi / 2])))
    [1. 0.]
    >>> print(wave.laplacian(jnp.zeros(()), jnp.array([0.0, jnp.pi / 2]))[0])
    -1.0
    """

    function: Callable[[Array, Array], Array] = eqx.field(converter=leaf_function)

    def check(self, dim: int) -> None:
        """A velocity of the scene's dimension, with derivatives."""
        t, x = jnp.zeros(()), jnp.zeros(dim)
        trial(jax.jacfwd(self.velocity, argnums=1), t, x)

    def velocity(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The function's value."""
        name, given = "VelocityField.function", "a time and a point"
        arguments = jnp.asarray(t, x.dtype), x
        return value_of(name, given, self.function, *arguments, shapes=(x.shape,), dtype=x.dtype)
