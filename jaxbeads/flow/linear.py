"""Flows with a uniform gradient."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail, finite, known, shape
from .._typing import float_array
from .base import AbstractLinearFlow


class Shear(AbstractLinearFlow):
    """Simple shear, u_x = rate y. **Argument** `rate`: shear rate [1/time].

    **Raises** `ValueError` for numbers that are not finite or of another shape.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.flow import Shear
    >>> bead = jb.Chain(radius=1.0, fibres=1)
    >>> scene = jb.Scene(bead, 1.0, flow=Shear(2.0), forces=[jb.force.Weight([0.0, 0.0])])
    >>> print(jb.dynamics.motion(0.0, jb.State([[0.0, 3.0]]), scene).velocity)
    [[6. 0.]]
    >>> print(Shear(2.0).gradient(jnp.zeros(()), 2))
    [[0. 2.]
     [0. 0.]]
    """

    rate: Float[Array, ""] = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        shape("rate", self.rate, ())
        finite("rate", self.rate)

    def gradient(self, t: Float[Array, ""], dim: int) -> Float[Array, "dim dim"]:
        """rate at entry (x, y)."""
        return jnp.zeros((dim, dim), self.rate.dtype).at[0, 1].set(self.rate)


class OscillatingShear(AbstractLinearFlow):
    """Time-dependent shear, u_x = rate cos(angular_frequency t + phase) y.

    **Arguments** `rate` [1/time], `angular_frequency` [rad/time], `phase` [rad].

    **Raises** `ValueError` for numbers that are not finite or of another shape.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.flow import OscillatingShear
    >>> flow = OscillatingShear(rate=2.0, angular_frequency=jnp.pi)
    >>> print(flow.velocity(jnp.ones(()), jnp.array([0.0, 3.0])))  # half a period later
    [-6.  0.]
    """

    rate: Float[Array, ""] = eqx.field(converter=float_array)
    angular_frequency: Float[Array, ""] = eqx.field(converter=float_array)
    phase: Float[Array, ""] = eqx.field(converter=float_array, default=0.0)

    def __check_init__(self) -> None:
        shape("rate", self.rate, ())
        finite("rate", self.rate)
        shape("angular_frequency", self.angular_frequency, ())
        finite("angular_frequency", self.angular_frequency)
        shape("phase", self.phase, ())
        finite("phase", self.phase)

    def gradient(self, t: Float[Array, ""], dim: int) -> Float[Array, "dim dim"]:
        """The present rate at entry (x, y)."""
        rate = self.rate * jnp.cos(self.angular_frequency * t + self.phase)
        return jnp.zeros((dim, dim), self.rate.dtype).at[0, 1].set(rate)


class Extension(AbstractLinearFlow):
    """Planar extension, u = rate (x, -y). **Argument** `rate` [1/time].

    **Raises** `ValueError` for numbers that are not finite or of another shape.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.flow import Extension
    >>> print(Extension(2.0).velocity(jnp.zeros(()), jnp.array([1.0, 3.0])))
    [ 2. -6.]
    """

    rate: Float[Array, ""] = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        shape("rate", self.rate, ())
        finite("rate", self.rate)

    def gradient(self, t: Float[Array, ""], dim: int) -> Float[Array, "dim dim"]:
        """rate, -rate on the diagonal."""
        return (
            jnp.zeros((dim, dim), self.rate.dtype).at[0, 0].set(self.rate).at[1, 1].set(-self.rate)
        )


class LinearFlow(AbstractLinearFlow):
    """Any linear flow, u = G x.

    **Argument** `matrix`: G_ij = du_i/dx_j [1/time], shape `(2, 2)` or `(3, 3)`. In space it must be
    free of divergence; in the plane the normal direction makes up for what is missing.

    **Raises** `ValueError` for another shape or a spatial gradient with a trace.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.flow import LinearFlow
    >>> flow = LinearFlow([[0.0, 2.0], [1.0, 0.0]])
    >>> print(flow.velocity(jnp.zeros(()), jnp.array([1.0, 3.0])))
    [6. 1.]
    """

    matrix: Float[Array, "dim dim"] = eqx.field(converter=float_array)

    def __init__(self, matrix: Any) -> None:
        self.matrix = float_array(matrix)

    def __check_init__(self) -> None:
        if self.matrix.shape not in ((2, 2), (3, 3)):
            fail("matrix", "have shape (2, 2) or (3, 3)", f"it has shape {self.matrix.shape}")
        finite("matrix", self.matrix)

    def check(self, dim: int) -> None:
        """A matrix of the scene's dimension, without a trace in space."""
        shape("LinearFlow.matrix", self.matrix, (dim, dim))
        if dim == 3 and known(self.matrix):
            trace, size = np.trace(self.matrix), np.max(np.abs(self.matrix))
            if abs(trace) > 1e-6 * size:
                fail("LinearFlow.matrix", "have no trace (incompressible)", f"it is {trace:g}")

    def gradient(self, t: Float[Array, ""], dim: int) -> Float[Array, "dim dim"]:
        """The matrix."""
        if self.matrix.shape[0] != dim:
            fail("matrix", f"have shape {(dim, dim)}", f"it has shape {self.matrix.shape}")
        return self.matrix
