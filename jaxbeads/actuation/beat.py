"""Directions of a driven base."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import finite, shape
from .._typing import float_array


class PlanarBeat(eqx.Module):
    """e(t) = (cos alpha, sin alpha), alpha = alpha_0 sin(zeta t): the base angle of eq. (60).

    **Arguments**: `amplitude` alpha_0 [rad]; `angular_frequency` zeta [1/time].

    **Raises** `ValueError` for numbers that are not finite or of another shape.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.actuation import PlanarBeat
    >>> print(PlanarBeat(amplitude=jnp.pi / 6, angular_frequency=1.0)(jnp.array(jnp.pi / 2)).round(4))
    [0.866 0.5  ]
    """

    amplitude: Float[Array, ""] = eqx.field(converter=float_array)
    angular_frequency: Float[Array, ""] = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        for name in ("amplitude", "angular_frequency"):
            shape(name, getattr(self, name), ())
            finite(name, getattr(self, name))

    def angle(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """alpha(t) [rad]."""
        return self.amplitude * jnp.sin(self.angular_frequency * t)

    def __call__(self, t: Float[Array, ""]) -> Float[Array, "2"]:
        """Unit vector."""
        alpha = self.angle(t)
        return jnp.stack([jnp.cos(alpha), jnp.sin(alpha)])


class HelicalBeat(eqx.Module):
    """R (cos alpha cos beta, cos alpha sin beta, sin alpha), alpha = alpha_0 sin(zeta t),
    beta = alpha_0 cos(zeta t): a direction that circles about x, eq. (62).

    **Arguments**: `amplitude` alpha_0 [rad]; `angular_frequency` zeta [1/time]; `distance` R, 1 for a
    direction, delta of eq. (62) for the position of a bead off the axis [length].

    **Raises** `ValueError` for numbers that are not finite or of another shape.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.actuation import HelicalBeat
    >>> print(HelicalBeat(amplitude=0.3, angular_frequency=1.0)(jnp.zeros(())).round(4))
    [0.9553 0.2955 0.    ]
    """

    amplitude: Float[Array, ""] = eqx.field(converter=float_array)
    angular_frequency: Float[Array, ""] = eqx.field(converter=float_array)
    distance: Float[Array, ""] = eqx.field(converter=float_array, default=1.0)

    def __check_init__(self) -> None:
        for name in ("amplitude", "angular_frequency", "distance"):
            shape(name, getattr(self, name), ())
            finite(name, getattr(self, name))

    def __call__(self, t: Float[Array, ""]) -> Float[Array, "3"]:
        """Vector of length `distance`."""
        alpha = self.amplitude * jnp.sin(self.angular_frequency * t)
        beta = self.amplitude * jnp.cos(self.angular_frequency * t)
        c = jnp.cos(alpha)
        return self.distance * jnp.stack([c * jnp.cos(beta), c * jnp.sin(beta), jnp.sin(alpha)])
