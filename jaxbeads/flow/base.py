"""What a flow is."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractFlow(eqx.Module):
    """Velocity of the undisturbed fluid. Spin and rate of strain follow by differentiation."""

    smooth: ClassVar[bool] = False
    """Whether the velocity changes little over a bead's radius and, unless it depends on the time, along
    a path of many. Adaptive steps look along their path for what others do."""

    def check(self, dim: int) -> None:
        """Refuse a dimension that the flow cannot serve, in one sentence."""

    @abc.abstractmethod
    def velocity(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Velocity at the point x [length/time]."""


class AbstractLinearFlow(AbstractFlow):
    """A flow u = G(t) x whose gradient is the same everywhere: cheaper than a general one."""

    smooth: ClassVar[bool] = True

    @abc.abstractmethod
    def gradient(self, t: Float[Array, ""], dim: int) -> Float[Array, "dim dim"]:
        """G_ij = du_i/dx_j [1/time] in `dim` dimensions."""

    def velocity(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """G x."""
        return self.gradient(t, x.shape[0]) @ x


def velocity_and_gradient(
    flow: AbstractFlow, t: Float[Array, ""], position: Float[Array, "beads dim"]
) -> tuple[Float[Array, "beads dim"], Float[Array, "*beads dim dim"]]:
    """Velocity at each bead, and the gradient: one for all in a linear flow, else one for each."""
    if isinstance(flow, AbstractLinearFlow):
        gradient = flow.gradient(t, position.shape[1])
        return position @ gradient.T, gradient
    velocity = jax.vmap(lambda x: flow.velocity(t, x))(position)
    return velocity, jax.vmap(jax.jacfwd(lambda x: flow.velocity(t, x)))(position)


def spin_and_strain(gradient: Float[Array, "*beads dim dim"]) -> tuple[Array, Array]:
    """Half the vorticity, shape `(*beads, spins)`, and the symmetric part of the gradient."""
    transpose = jnp.swapaxes(gradient, -1, -2)
    skew, strain = 0.5 * (gradient - transpose), 0.5 * (gradient + transpose)
    if gradient.shape[-1] == 2:
        return skew[..., 1, 0][..., None], strain
    return jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1), strain
