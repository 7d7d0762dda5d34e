"""The result of `optimise`."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, PyTree

from ._checks import known, said


class History(eqx.Module):
    """What happened in each step: `loss`, `gradient_norm` (of the loss, or with a constraint of the
    augmented Lagrangian, by the free values), `violation` (largest absolute value of the constraint),
    `(steps,)` or `(steps, starts)`; `time` [s]. Free values of the default optimiser are parts of units.
    """

    loss: np.ndarray
    gradient_norm: np.ndarray
    violation: np.ndarray
    time: np.ndarray


STEPS, VANISHES, NOT_FINITE, INTERRUPTED, NO_FURTHER, ZERO = range(101, 107)
_ENDINGS = {
    STEPS: "took all {} steps",
    VANISHES: "the gradient vanishes",
    NOT_FINITE: "stopped: the loss is not finite at step {}",
    INTERRUPTED: "interrupted",
    NO_FURTHER: "the loss falls no further",
    ZERO: "the gradient is zero at the start",
}
"""Why it ended. A sum or a difference of two of the numbers is none of them."""


def _few(value: Array) -> str:
    """Numbers where they are few, or their shape."""
    return said(value) if np.size(value) <= 4 else str(np.shape(value))


class Optimum(eqx.Module):
    """The result of `optimise`.

    - `values`, `loss`, `violation`: of the best step (with a constraint: the last); with `many`, a
      leading axis of starts.
    - `history`: see `History`; `status`: why it ended, which `ending` is a number for: two results of
      one shape have one structure.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> best = jb.optimise(lambda x: jnp.sum((x - 3.0) ** 2), jnp.array([0.0, 1.0]), progress=False)
    >>> print(best.loss < 1e-12, best.status)
    True the gradient vanishes
    """

    values: PyTree
    loss: Array
    violation: Array
    history: History
    ending: Array

    def __str__(self) -> str:
        """What was found, in a few lines; under a transformation, its structure."""
        if not known(self):
            return eqx.tree_pformat(self)
        history = self.history
        steps, *many = np.shape(history.loss)
        of = f" (best of {many[0]} starts)" if many else ""
        took = f", {float(np.max(history.time)):.3g} s" if steps else ""
        lines = [f"Optimum: loss {np.nanmin(self.loss):.6g}{of}, {self.status}"]
        if steps:
            first = np.nanmin(history.loss[0])
            norms = (np.nanmin(history.gradient_norm[k]) for k in (0, -1))
            fell = " to ".join(f"{norm:.2e}" for norm in norms)
            lines.append(f"{steps} steps{took}, loss at first {first:.6g}, gradient norm {fell}")
        worst = float(np.max(np.abs(self.violation))) if np.size(self.violation) else 0.0
        if worst > 0:
            lines.append(f"constraint violated by {worst:.2e} at most")
        leaves = jax.tree_util.tree_leaves_with_path(self.values)
        shown = (f"{jax.tree_util.keystr(path)} {_few(leaf)}".strip() for path, leaf in leaves[:8])
        lines.append("values: " + ", ".join(shown))
        lines.append("what happened in each step is in `history`")
        return "\n  ".join(lines)

    @property
    def status(self) -> str:
        """Why it ended, in words; "traced" under a transformation. A host function."""
        if not known((self.ending, self.history.loss)):
            return "traced"
        return _ENDINGS.get(int(self.ending), "unknown").format(len(self.history.loss))
