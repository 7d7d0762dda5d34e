"""Third-order Adams-Bashforth with a Runge-Kutta start."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import PyTree

from .base import AbstractSolver


class AdamsBashforth(diffrax.AbstractSolver):
    """y_{n+1} = y_n + h (23 f_n - 16 f_{n-1} + 5 f_{n-2}) / 12, eq. (38): one evaluation a step.

    The first two steps are classical Runge-Kutta steps of order 4: a start by Euler or AB2 would
    make the whole of order 2. All steps must be equally long. Values between steps are interpolated
    linearly, so times at which to save should be steps.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., Any]] = diffrax.LocalLinearInterpolation

    def order(self, terms: PyTree) -> int:
        """3."""
        return 3

    def init(self, terms: Any, t0: Any, t1: Any, y0: PyTree, args: PyTree) -> PyTree:
        """Two past derivatives, the number of steps done, and where the first two steps lead: they are
        taken here, because a branch in each step would be dear to differentiate.
        """
        h = t1 - t0

        def start(y: PyTree, t: Any) -> tuple[PyTree, PyTree]:
            after = _runge_kutta(terms, t, h, y, args)
            return after, after

        # Loops of loops: the right-hand side is compiled once.
        _, begun = lax.scan(start, y0, jnp.stack([jnp.asarray(t0), jnp.asarray(t1)]))
        first, second = (jax.tree.map(lambda y, k=k: y[k], begun) for k in range(2))
        past = jax.tree.map(jnp.zeros_like, y0)
        return past, past, jnp.zeros((), jnp.int32), (first, second)

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: Any,
    ) -> tuple[PyTree, None, dict, PyTree, diffrax.RESULTS]:
        """One step from t0 to t1."""
        f1, f2, count, begun = solver_state
        h = t1 - t0
        f0 = terms.vf(t0, y0, args)

        def update(y: Any, a: Any, b: Any, c: Any, first: Any, second: Any) -> Any:
            later = y + h * ((23 * a - 16 * b + 5 * c) / 12)
            return jnp.where(count == 0, first, jnp.where(count == 1, second, later))

        y1 = jax.tree.map(update, y0, f0, f1, f2, *begun)
        memory = f0, f1, count + 1, begun
        return y1, None, {"y0": y0, "y1": y1}, memory, diffrax.RESULTS.successful

    def func(self, terms: Any, t0: Any, y0: PyTree, args: PyTree) -> PyTree:
        """The right-hand side."""
        return terms.vf(t0, y0, args)


class AB3(AbstractSolver):
    """The paper's explicit scheme, with equal steps, as `AB3(substeps=50)`: one evaluation a step.

    Stable for `Bending` up to about 2.2 times the step (39), which it takes unless told otherwise.

    **Arguments**, by name: `substeps` and `projected`, as for `AbstractSolver`; it estimates no error.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> scene = jb.Scene(chain, 1.0, forces=[jb.force.Weight([0.0, -1.0])])
    >>> state = jb.straight(chain, [1.0, 0.0])
    >>> solution = jb.rollout(scene, state, [0.0, 1.0, 2.0], solver=jb.AB3(substeps=5))
    >>> print(solution.steps, solution.code)
    10 0
    """

    equal_steps: ClassVar[bool] = True
    stable_to: ClassVar[float | None] = 2.2
    evaluations: ClassVar[float] = 1

    @property
    def scheme(self) -> AdamsBashforth:
        """Of order 3."""
        return AdamsBashforth()


def _runge_kutta(terms: Any, t0: Any, h: Any, y0: PyTree, args: PyTree) -> PyTree:
    """One classical step of order 4."""

    def stage(carry: PyTree, weights: Any) -> tuple[PyTree, None]:
        total, previous = carry
        at, weight = weights
        y = jax.tree.map(lambda y, k: y + at * h * k, y0, previous)
        f = terms.vf(t0 + at * h, y, args)
        return (jax.tree.map(lambda s, k: s + weight * k, total, f), f), None

    weights = jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 2.0, 1.0])
    weights = jax.tree.map(lambda w: w.astype(jax.tree.leaves(y0)[0].dtype), weights)
    zero = jax.tree.map(jnp.zeros_like, y0)
    (total, _), _ = lax.scan(jax.checkpoint(stage), (zero, zero), weights)
    return jax.tree.map(lambda y, s: y + h * (s / 6), y0, total)
