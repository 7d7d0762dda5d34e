"""How long explicit steps may be, and how many of them there are between two save times."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail
from .._compat import Tracer
from ..scene import Scene


@eqx.filter_jit
def explicit_step(scene: Scene) -> Float[Array, ""]:
    """Time step for explicit solvers [time]: the smallest that a force asks for. With `Bending` the
    paper's mu (2a)^4 / K_b, eq. (39), for the smallest radius and the largest rigidity; infinite without
    stiff forces.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> scene = jb.Scene(chain, viscosity=1.0, forces=[jb.force.Bending(16.0)])
    >>> print(jb.solver.explicit_step(scene))  # mu (2a)^4 / K_b
    1.0
    """
    steps = [f.explicit_step(scene) for f in scene.forces]
    return jnp.min(jnp.stack([jnp.asarray(jnp.inf), *steps]))


def substeps_for(scene: Scene, ts: Any, step: float | None = None) -> int:
    """Number of equal steps between save times, from a largest step (by default `explicit_step`).

    A host function. **Raises** `ValueError` if there is neither a step nor a stiff force, and for times
    and numbers of the scene that are traced: call it outside of what is compiled or differentiated.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> scene = jb.Scene(chain, viscosity=1.0, forces=[jb.force.Bending(16.0)])
    >>> jb.solver.substeps_for(scene, [0.0, 10.0, 20.0]) >= 10  # a safe step is 1
    True
    """
    if _traced(ts):
        fail("ts", "hold known numbers", "it is traced: call `substeps_for` outside")
    if step is None and _traced(scene):
        how = "it is traced: call `substeps_for` outside, with the stiffest value"
        fail("scene", "hold known numbers", how)
    # Inside of a traced function too, of what is known there.
    with jax.ensure_compile_time_eval():
        limit = float(explicit_step(scene)) if step is None else step
    if not np.isfinite(limit):
        raise ValueError(
            "Argument `substeps` must be given, but it is None and the scene has no bending rigidity "
            "from which a time step would follow."
        )
    gap, times = float(np.max(np.diff(ts))), 1.0 * np.asarray(ts)
    # What rounding adds to a whole number of steps, of the times or of the step, is no step.
    slack = 4 * float(np.spacing(np.max(np.abs(times)))) / gap + 10 * float(
        jnp.finfo(times.dtype).eps
    )
    steps = max(1, int(np.ceil(gap / limit * (1 - max(1e-9, slack)))))
    block = int(np.sqrt(steps))  # a number that `FixedSteps` can cut into blocks
    return -(-steps // block) * block


def _traced(tree: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))
