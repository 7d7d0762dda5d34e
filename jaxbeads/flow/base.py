"""What a flow is."""

import abc
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractFlow(eqx.Module):
    """Velocity of the undisturbed fluid. Spin and rate of strain follow by differentiation.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.flow import AbstractFlow
    >>> class Vortex(AbstractFlow):
    ...     def velocity(self, t, x):
    ...         return jnp.stack([-x[1], x[0]]) / (1.0 + x @ x)
    >>> print(Vortex().velocity(jnp.zeros(()), jnp.array([0.0, 1.0])))
    [-0.5  0. ]
    """

    smooth: ClassVar[bool] = False
    """Whether the velocity changes little over a bead's radius and, unless it depends on the time, along
    a path of many. Adaptive steps look along their path for what others do."""

    def check(self, dim: int) -> None:
        """Refuse a dimension that the flow cannot serve, in one sentence."""

    @abc.abstractmethod
    def velocity(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Velocity at the point x [length/time]."""

    def laplacian(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Laplacian of the velocity at the point x [1/(length time)], by differentiation unless
        overridden. (A planar flow is the same at any height above its plane.)
        """

        def second(axis: Array) -> Array:
            along = partial(jax.jvp, lambda x: self.velocity(t, x))
            return jax.jvp(lambda x: along((x,), (axis,))[1], (x,), (axis,))[1]

        return jnp.sum(jax.vmap(second)(jnp.eye(len(x), dtype=x.dtype)), axis=0)


class AbstractLinearFlow(AbstractFlow):
    """A flow u = G(t) x whose gradient is the same everywhere: cheaper than a general one.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.flow import AbstractLinearFlow
    >>> class Turning(AbstractLinearFlow):
    ...     def gradient(self, t, dim):
    ...         return jnp.array([[0.0, -1.0], [1.0, 0.0]])
    >>> print(Turning().velocity(jnp.zeros(()), jnp.array([2.0, 1.0])))
    [-1.  2.]
    """

    smooth: ClassVar[bool] = True

    @abc.abstractmethod
    def gradient(self, t: Float[Array, ""], dim: int) -> Float[Array, "dim dim"]:
        """G_ij = du_i/dx_j [1/time] in `dim` dimensions."""

    def velocity(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """G x."""
        return self.gradient(t, x.shape[0]) @ x


def velocity_and_gradient(
    flow: AbstractFlow,
    t: Float[Array, ""],
    position: Float[Array, "beads dim"],
    radius: Float[Array, ""] | Float[Array, " beads"],
) -> tuple[Float[Array, "beads dim"], Float[Array, "*beads dim dim"]]:
    """Velocity and its gradient as a sphere at each bead feels them: means over its surface,

        (1 + a^2/6 lap) u  and  (1 + a^2/10 lap) grad u,

    Faxen's laws (Kim & Karrila, Microhydrodynamics, section 3.5); the second makes no difference to the
    spin in a Stokes flow. In a linear flow they are the values at the centre, with one gradient for all
    beads, else with one for each.
    """
    if isinstance(flow, AbstractLinearFlow):
        gradient = flow.gradient(t, position.shape[1])
        return position @ gradient.T, gradient

    def mean(x: Array, share: Array) -> Array:
        return flow.velocity(t, x) + share * flow.laplacian(t, x)

    square = jnp.broadcast_to(radius**2, position.shape[:1])
    velocity = jax.vmap(mean)(position, square / 6)
    return velocity, jax.vmap(jax.jacfwd(mean))(position, square / 10)


def spin_and_strain(gradient: Float[Array, "*beads dim dim"]) -> tuple[Array, Array]:
    """Half the vorticity, shape `(*beads, spins)`, and the symmetric part of the gradient."""
    transpose = jnp.swapaxes(gradient, -1, -2)
    skew, strain = 0.5 * (gradient - transpose), 0.5 * (gradient + transpose)
    if gradient.shape[-1] == 2:
        return skew[..., 1, 0][..., None], strain
    return jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1), strain
