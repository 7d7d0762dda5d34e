"""Conjugate gradients, and iterations that learn from those before.

Why not `lineax.CG`, which is the same method: its program takes half as long again to compile and a few
more iterations (200 rows, diagonal preconditioner: 17 against 14), because it asks for small numbers in
the residual; here r.P r bounds the error of the velocities. A solution that was not found is NaN here,
which `Outcome` reports without an error that is raised from within a compiled program.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

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
MOST_ACCELERATED, MOST_LEARNING = 25, 32
"""Iterations after which it gives up; where most are cheap."""
_FALLS = 0.1, 0.9
"""Between which one step of it is thought to be over the step before."""


class Accelerated(NamedTuple):
    """What accelerated iterations found."""

    solution: Float[Array, " numbers"]
    """Also where they did not converge."""
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]
    known: Any = None
    """What steps know, of those that learn."""


class _Turn(NamedTuple):
    """Between iterations."""

    z: Array
    before: Array
    """The last z."""
    change_before: Array
    ways: Array
    changes: Array
    last: Array
    """Size of the last change."""
    left: Array
    number: Array
    known: Any
    learn: Array
    """Whether the step that comes is one that learns."""
    done: Array


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
    return _accelerated(lambda z, _: step(z), None, None, start, enough)


def learning(
    step: Callable[[Array, Any], tuple[Array, Array]],
    learn: Callable[[Array], tuple[Array, Array, Any]],
    known: Any,
    start: Float[Array, " numbers"],
    enough: Float[Array, ""],
) -> Accelerated:
    """The same where f is dear, and cheap with what is known of it: what a cheap form leaves out, which
    hardly changes. When iterations of that form have ended it is learned anew, and they go on until a
    step that learns ends them.

    **Arguments**: cheap form of f of z and of what is known, and its size; f, its size, and what there
    is to know at z; what is known at first; first z; what may be left.
    """
    return _accelerated(step, learn, known, start, enough)


def _accelerated(
    step: Callable[[Array, Any], tuple[Array, Array]],
    learn: Callable[[Array], tuple[Array, Array, Any]] | None,
    known: Any,
    start: Array,
    enough: Array,
) -> Accelerated:
    dtype, count = start.dtype, len(start)
    limit = MOST_ACCELERATED if learn is None else MOST_LEARNING

    def unfinished(turn: _Turn) -> Array:
        return ~turn.done & (turn.number < limit) & jnp.isfinite(turn.last)

    def body(turn: _Turn) -> _Turn:
        z, known, first = turn.z, turn.known, turn.number == 0

        def cheap() -> tuple[Array, Array, Any]:
            return *step(z, known), known

        if learn is None:
            change, size, known = cheap()
        else:
            dear = partial(learn, z)
            change, size, known = lax.cond(turn.learn, dear, cheap)
        slot = (turn.number - 1) % DEPTH
        # From one form of f to another says nothing of how f changes.
        new = ~first & ~turn.learn
        part = jnp.where(new, jnp.clip(size / turn.last, *_FALLS), 0.5)
        left = size * part / (1 - part)
        ways = turn.ways.at[slot].set(jnp.where(new, z - turn.before, 0.0))
        changes = turn.changes.at[slot].set(jnp.where(new, change - turn.change_before, 0.0))
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
        ended = left <= enough
        done = ended if learn is None else ended & turn.learn
        return _Turn(
            after, z, change, ways, changes, size, left, turn.number + 1, known, ended & ~done, done
        )

    none, most = jnp.zeros((DEPTH, count), dtype), jnp.asarray(jnp.finfo(dtype).max, dtype)
    no = jnp.zeros((), bool)
    turn = _Turn(start, start, start, none, none, most, most, jnp.zeros((), int), known, no, no)
    turn = lax.while_loop(unfinished, body, turn)
    return Accelerated(turn.z, turn.done, turn.number, turn.known)
