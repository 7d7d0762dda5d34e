"""What a tolerance means: the error of a step as a fraction of the fibre's length."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..carried import largest
from ..chain import Chain
from ..state import State


class LargestError(eqx.Module):
    """Norm of the error of a state: how far the worst bead is off, or the tip of an arm that turns with
    what it carries [length].

    **Argument**: `arm`, its length.
    """

    arm: Float[Array, ""]

    def __call__(self, error: State) -> Float[Array, ""]:
        """The largest."""
        return largest(error, self.arm)


def controller_for(tolerance: Float[Array, ""] | float, chain: Chain) -> diffrax.PIDController:
    """Steps whose estimated error is at most `tolerance` times the longest fibre's length."""
    length = jnp.max(chain.length)
    return diffrax.PIDController(rtol=0.0, atol=tolerance * length, norm=LargestError(length))


def default_tolerance(dtype: jnp.dtype) -> float:
    """1e-6; in single precision 1e-4, which rounding leaves room for."""
    return 1e-6 if jnp.finfo(dtype).eps < 1e-9 else 1e-4
