"""Pressure-driven flow between plates."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import finite, positive, shape
from .._typing import float_array
from .base import AbstractFlow


class Poiseuille(AbstractFlow):
    """Plane Poiseuille flow, u_x = speed (1 - (y / half_width)^2). The plates are not modelled.

    A sphere is slower than the fluid at its centre, by speed a^2 / (3 half_width^2).

    **Arguments** `speed` on the centre line [length/time], `half_width` [length], positive.

    **Raises** `ValueError` for a half width that is not positive, and numbers that are not finite.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.flow import Poiseuille
    >>> flow = Poiseuille(speed=2.0, half_width=10.0)
    >>> print(flow.velocity(jnp.zeros(()), jnp.array([0.0, 5.0])))
    [1.5 0. ]
    """

    smooth: ClassVar[bool] = True
    speed: Float[Array, ""] = eqx.field(converter=float_array)
    half_width: Float[Array, ""] = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        shape("speed", self.speed, ())
        shape("half_width", self.half_width, ())
        finite("speed", self.speed)
        positive("half_width", self.half_width)

    def velocity(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The parabola."""
        return jnp.zeros_like(x).at[0].set(self.speed * (1 - (x[1] / self.half_width) ** 2))

    def laplacian(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The pressure gradient over the viscosity, the same everywhere."""
        return jnp.zeros_like(x).at[0].set(-2 * self.speed / self.half_width**2)
