"""What a tolerance means: the error of a step as a fraction of the fibre's length."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from ..carried import largest
from ..chain import Chain
from ..state import State

SAFETY = 0.9
"""The next step over the one that would just meet the tolerance."""
_SHORTEST, _LONGEST, _AGAIN = 0.2, 10.0, 0.6
"""The next step over the one before, at least and at most; at most where that was not kept."""
_FAILED = 0.5
"""The same where there is no error to go by: beads passed through one another, say."""
_BEFORE = 0.3
"""Weight of the error before."""
_LEAST = 1e-6
"""Errors are thought to be no smaller than that, over the most that there may be."""


class LargestError(eqx.Module):
    """Norm of the error of a state: how far the worst bead is off, or the tip of an arm that turns with
    what it carries [length].

    **Argument**: `arm`, its length.
    """

    arm: Float[Array, ""]

    def __call__(self, error: State) -> Float[Array, ""]:
        """The largest."""
        return largest(error, self.arm)


class Eased(diffrax.AbstractStepSizeController):
    """Steps h whose error e is at most `tolerance` times `arm`, of which few are taken again,

        h_(n+1) = 0.9 h_n e_n^(-1/k) e_(n-1)^(0.3/k),

    with e in units of the most that there may be: a proportional-integral controller (Gustafsson, Lundh
    & Soederlind, BIT 28 (1988) 270). Unlike `diffrax.PIDController` it shortens steps before their error
    is too large. One whose error was is taken again without the error before, with 0.6 of its length at
    most: where beads meet, errors fall more slowly than like h^k.
    """

    tolerance: Float[Array, ""]
    arm: Float[Array, ""]

    def wrap(self, direction: Any) -> "Eased":
        """The same."""
        return self

    def init(
        self,
        terms: PyTree,
        t0: Any,
        t1: Any,
        y0: State,
        dt0: Any,
        args: PyTree,
        func: Callable[..., Any],
        error_order: Any,
    ) -> tuple[Any, Float[Array, ""]]:
        """End of the first step, and an error before it: just the one that there may be."""
        return t0 + (t1 - t0 if dt0 is None else dt0), jnp.ones((), y0.position.dtype)

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: State,
        y1_candidate: State,
        args: PyTree,
        y_error: Any,
        error_order: Any,
        controller_state: Float[Array, ""],
    ) -> tuple[Any, Any, Any, Any, Float[Array, ""], diffrax.RESULTS]:
        """Whether the step is kept, begin and end of the next, that nothing jumps, the error."""
        error = lax.stop_gradient(largest(y_error, self.arm) / (self.tolerance * self.arm))
        keep = error <= 1  # not where it is no number
        error = jnp.maximum(error, _LEAST)
        before = jnp.where(keep, controller_state, 1.0) ** (_BEFORE / error_order)
        wanted = SAFETY * error ** (-1 / error_order) * before
        wanted = jnp.where(jnp.isfinite(error), wanted, _FAILED)
        longer = jnp.clip(wanted, _SHORTEST, jnp.where(keep, _LONGEST, _AGAIN))
        begin, last = jnp.where(keep, t1, t0), jnp.where(keep, error, controller_state)
        return keep, begin, begin + longer * (t1 - t0), False, last, diffrax.RESULTS.successful


def controller_for(tolerance: Float[Array, ""] | float, chain: Chain) -> diffrax.PIDController:
    """Steps whose estimated error is at most `tolerance` times the longest fibre's length."""
    length = jnp.max(chain.length)
    return diffrax.PIDController(rtol=0.0, atol=tolerance * length, norm=LargestError(length))


def default_tolerance(dtype: jnp.dtype) -> float:
    """1e-6; in single precision 1e-4, which rounding leaves room for."""
    return 1e-6 if jnp.finfo(dtype).eps < 1e-9 else 1e-4
