"""Conjugate gradients, and iterations that learn from those before.

Why not `lineax.CG`, which is the same method: its program takes half as long again to compile and a few
more iterations (200 rows, diagonal preconditioner: 17 against 14), because it asks for small numbers in
the residual; here r.P r bounds the error of the velocities. A solution that was not found is NaN here,
which `Outcome` reports without an error that is raised from within a compiled program.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .factors import cholesky, cholesky_solve

MOST = 500
"""Iterations after which the solution is given up."""


class Found(NamedTuple):
    """What iterations found."""

    solution: Float[Array, " rows"]
    """NaN if they did not converge."""
    iterations: Int[Array, ""]


def tolerance(dtype: jnp.dtype) -> float:
    """Relative error at which iterations end: 1e-12, in single precision 1e-5."""
    return 1e-12 if jnp.finfo(dtype).eps < 1e-9 else 1e-5


def conjugate_gradients(
    product: Callable[[Array], Array],
    rhs: Float[Array, " rows"],
    precondition: Callable[[Array], Array],
) -> Found:
    """Solution of S x = rhs with a positive matrix S by preconditioned conjugate gradients.

    It ends when the residual r, measured by r.P r with the preconditioner P, has fallen by the square of
    `tolerance`.

    **Arguments**: x -> S x; right-hand side; r -> P r, positive as well and close to S^-1.
    """
    # Squares of small numbers may be too small, in single precision.
    scale = jnp.max(jnp.abs(rhs), initial=0.0)
    scale = jnp.where(scale == 0, 1.0, scale)
    rhs = rhs / scale
    first = precondition(rhs)
    size = rhs @ first
    enough = tolerance(rhs.dtype) ** 2 * size

    def unfinished(turn: tuple[Array, ...]) -> Array:
        *_, size, count = turn
        return (size > enough) & (count < MOST)  # also ends with NaN

    def body(turn: tuple[Array, ...]) -> tuple[Array, ...]:
        x, residual, direction, size, count = turn
        along = product(direction)
        step = size / (direction @ along)
        residual = residual - step * along
        next_ = precondition(residual)
        new = residual @ next_
        return x + step * direction, residual, next_ + new / size * direction, new, count + 1

    start = jnp.zeros_like(rhs), rhs, first, size, jnp.zeros((), int)
    x, _, _, size, count = lax.while_loop(unfinished, body, start)
    return Found(jnp.where(size <= enough, scale * x, jnp.nan), count)


DEPTH = 12
"""Earlier iterations of which `accelerated` makes use."""
MOST_ACCELERATED = 25
"""Iterations after which it gives up."""
_FALLS = 0.1, 0.9
"""Between which one step of it is thought to be over the step before."""


class Accelerated(NamedTuple):
    """What accelerated iterations found."""

    solution: Float[Array, " numbers"]
    """Also where they did not converge."""
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]


def accelerated(
    step: Callable[[Array], tuple[Array, Array]],
    start: Float[Array, " numbers"],
    enough: Float[Array, ""],
) -> Accelerated:
    """Solution z of f(z) = 0 from iterations z + f(z), f small where z is near, that converge or nearly
    do (Anderson, J. ACM 12 (1965) 547).

    Of the last few steps a combination is sought that leaves the least of f, as if f were linear, and
    the next step starts there. Of a linear f they are those of GMRES without the distant past.

    **Arguments**: z -> (f, its size); first z; what may be left of f, f added once more: so much as the
    last two let expect.
    """
    dtype, count = start.dtype, len(start)

    def unfinished(turn: tuple[Array, ...]) -> Array:
        *_, size, left, number = turn
        return ~(left <= enough) & (number < MOST_ACCELERATED) & jnp.isfinite(size)

    def body(turn: tuple[Array, ...]) -> tuple[Array, ...]:
        z, before, change_before, ways, changes, last, _, number = turn
        change, size = step(z)
        slot = (number - 1) % DEPTH
        new = number > 0
        part = jnp.where(new, jnp.clip(size / last, *_FALLS), 0.5)
        left = size * part / (1 - part)
        ways = ways.at[slot].set(jnp.where(new, z - before, 0.0))
        changes = changes.at[slot].set(jnp.where(new, change - change_before, 0.0))
        gram, rhs = changes @ changes.T, changes @ change
        weight = jnp.diagonal(gram)
        weight = 1 / jnp.sqrt(jnp.where(weight > 0, weight, 1.0))
        gram = gram * weight[:, None] * weight[None, :]
        little = 100 * jnp.finfo(dtype).eps
        gram = gram + jnp.diag(jnp.where(jnp.diagonal(gram) > 0, little, 1.0))
        factor, positive = cholesky(gram)
        parts = weight * cholesky_solve(factor, weight * rhs)
        parts = jnp.where(positive & jnp.isfinite(parts), parts, 0.0)
        after = z + change - parts @ (ways + changes)
        return after, z, change, ways, changes, size, left, number + 1

    none, most = jnp.zeros((DEPTH, count), dtype), jnp.asarray(jnp.finfo(dtype).max, dtype)
    first = start, start, start, none, none, most, most
    z, *_, left, number = lax.while_loop(unfinished, body, (*first, jnp.zeros((), int)))
    return Accelerated(z, left <= enough, number)
