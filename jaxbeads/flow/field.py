"""A user's velocity field, without a class of its own."""

from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, Float

from .._typing import leaf_function
from .base import AbstractFlow


class VelocityField(AbstractFlow):
    """u = f(t, x) from a function of the time and one point, shape `(dim,)`.

    Spin and rate of strain follow by differentiation. A function that is a pytree (an
    `equinox.Module`) keeps its parameters as leaves; what a plain function closes over is constant.
    """

    function: Callable[[Array, Array], Array] = eqx.field(converter=leaf_function)

    def velocity(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The function's value."""
        return self.function(t, x)
