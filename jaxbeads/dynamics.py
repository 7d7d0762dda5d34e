"""What happens at one instant: motion, multipliers, loads, and what is wrong with the constraints.

The saddle-point system itself is in `instant`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._typing import with_all_digits
from .coincidence import coincidence
from .constraint import AbstractConstraint
from .factors import symmetric
from .instant import (
    Evaluation,
    ambient_motion,
    applied_load,
    evaluation,
    fluid_motion,
    free_motion,
    rate,
    solved,
)
from .saddle import Time, constraint_map, matrix, saddle_point, slips
from .scene import Scene, in_single
from .state import Load, Motion, State, check_single, zero_motion

__all__ = [
    "ambient_motion",
    "applied_load",
    "constraint_load",
    "constraint_matrix",
    "constraint_residual",
    "evaluate",
    "fluid_motion",
    "free_motion",
    "motion",
    "multipliers",
    "named",
    "rate",
    "redundancy",
]


def evaluate(t: Time, state: State, scene: Scene) -> Evaluation:
    """Motion and multipliers at one instant.

    S is factorised once. Derivatives go through the linear system (implicit function), never through
    the factorisation: they reuse the factor and differentiate J M J^T lambda for fixed lambda.

    **Arguments**: time; `State`; `Scene`. **Returns** an `Evaluation`; its numbers are NaN if S is
    singular to rounding (redundant or contradictory constraints, see `redundancy`).

    >>> import jaxbeads as jb
    >>> gears, weight = jb.constraint.Gears(), jb.force.Weight([0.0, -1.0])
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), 1.0, constraints=[gears], forces=[weight])
    >>> now = jb.dynamics.evaluate(0.0, jb.straight(scene.chain, [1.0, 0.0]), scene)
    >>> print(now.motion.velocity[:, 1].round(5), now.multipliers.shape)
    [-0.08672 -0.09927 -0.08672] (4,)
    """
    check_single(state)
    return evaluation(jnp.asarray(t), state, scene, None)


def motion(t: Time, state: State, scene: Scene) -> Motion:
    """Velocities [length/time] and spins [1/time] of all beads at one instant.

    >>> import jaxbeads as jb
    >>> gears, weight = jb.constraint.Gears(), jb.force.Weight([0.0, -1.0])
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), 1.0, constraints=[gears], forces=[weight])
    >>> along = jb.dynamics.motion(0.0, jb.straight(scene.chain, [0.0, 1.0]), scene)
    >>> print(along.velocity[:, 1].round(5))
    [-0.10707 -0.10707 -0.10707]
    """
    return evaluate(t, state, scene).motion


def multipliers(t: Time, state: State, scene: Scene) -> Array:
    """Lagrange multipliers lambda of all constraints, raveled one after the other [force].

    >>> import jaxbeads as jb
    >>> hung = [jb.constraint.Inextensible(), *jb.constraint.hinged()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=3), 1.0, constraints=hung, forces=[jb.force.Weight([0.0, -1.0])]
    ... )
    >>> down = jb.straight(scene.chain, [0.0, -1.0])
    >>> print(jb.dynamics.multipliers(0.0, down, scene)[:2].round(6))  # minus the tensions
    [2. 1.]
    """
    return evaluate(t, state, scene).multipliers


def constraint_load(t: Time, state: State, scene: Scene) -> Load:
    """Forces and torques of the constraints, J^T lambda, eq. (11) [force, force length].

    >>> import jaxbeads as jb
    >>> hung = [jb.constraint.Inextensible(), *jb.constraint.hinged()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=3), 1.0, constraints=hung, forces=[jb.force.Weight([0.0, -1.0])]
    ... )
    >>> load = jb.dynamics.constraint_load(0.0, jb.straight(scene.chain, [0.0, -1.0]), scene)
    >>> print(load.force[:, 1].round(6))  # they carry the weight
    [1. 1. 1.]
    """
    return constraint_map(t, state, scene).pull(multipliers(t, state, scene))


def constraint_matrix(t: Time, state: State, scene: Scene) -> Float[Array, "rows rows"]:
    """S = J M J^T in full, `(rows, rows)`, a row for each number of `slip` (only needed to look at it:
    condition, rank).

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), 1.0, constraints=[jb.constraint.Inextensible()])
    >>> s = jb.dynamics.constraint_matrix(0.0, jb.straight(scene.chain, [1.0, 0.0]), scene)
    >>> print(s.shape, abs(s - s.T).max() < 1e-15)
    (2, 2) True
    """
    return _full_matrix(jnp.asarray(t), state, scene)


@with_all_digits
@eqx.filter_jit
def _full_matrix(t: Time, state: State, scene: Scene) -> Array:
    operator = scene.operator(state)
    whole = operator.kept() if scene.dense else operator.some(jnp.arange(scene.chain.beads))
    return symmetric(matrix(t, state, scene, whole))


@with_all_digits
@eqx.filter_jit
def _answer(t: Time, state: State, scene: Scene) -> Array:
    """Multipliers that stop some motion of the beads, whatever their loads; NaN if nothing can."""
    system = saddle_point(t, state, scene, scene.operator(state).kept())
    still = zero_motion(state, scene.rotational)
    moved = jax.tree.map(lambda v: jnp.cos(jnp.arange(v.size)).reshape(v.shape), still)
    return system.multipliers(system.constraints.slip(moved))


def named(constraint: AbstractConstraint) -> str:
    """Its name, with the bead or bond that it is about.

    >>> import jaxbeads as jb
    >>> print(jb.dynamics.named(jb.constraint.PrescribedPosition(bead=2)))
    PrescribedPosition(bead=2)
    """
    about = (f"{x}={getattr(constraint, x)}" for x in ("bead", "bond") if hasattr(constraint, x))
    where = ", ".join(about)
    return type(constraint).__name__ + (f"({where})" if where else "")


def redundancy(t: Time, state: State, scene: Scene) -> str | None:
    """Whether the constraints depend on one another at this instant, and which of them.

    Looks at the null vectors of S, each of them a combination of rows that demands nothing new. If the
    velocities that these rows prescribe do not agree either, no motion meets them. Where the constraints
    are independent (J has no null vector) and S is singular all the same, it is since beads in one place
    move as one; then it says which.

    Where the mobility is not dense there are too many for eigenvalues: then iterations that do not
    converge tell that some depend on one another, but not which.

    **Returns** a sentence, or `None` if the constraints are independent. A host function.

    >>> import jaxbeads as jb
    >>> twice = [jb.constraint.Inextensible(), jb.constraint.Inextensible()]
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), viscosity=1.0, constraints=twice)
    >>> print(jb.dynamics.redundancy(0.0, jb.straight(scene.chain, [1.0, 0.0]), scene))
    Inextensible + Inextensible are redundant: 2 of their rows depend on the others
    """
    if not scene.constraints:
        return None
    if not scene.dense:
        if np.all(np.isfinite(_answer(jnp.asarray(t), state, scene))):
            return None
        if (how := _together(state, scene)) is not None:
            return how
        names = " + ".join(map(named, scene.constraints))
        return f"{names} depend on one another: iterations do not converge"
    matrix = np.asarray(constraint_matrix(t, state, scene))
    if matrix.size == 0:  # as one bead under `Gears`
        return None
    if not np.all(np.isfinite(matrix)):
        return f"the matrix J M J^T is not finite{in_single(matrix.dtype)}"
    scale = np.sqrt(np.abs(np.diagonal(matrix)))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    null = vectors[:, values < 10 * len(values) * np.finfo(matrix.dtype).eps * values[-1]]
    if null.shape[1] == 0:
        return None
    time = jnp.asarray(t)
    if (how := _together(state, scene)) is not None and _pushes(time, state, scene, null):
        return how
    still = zero_motion(state, scene.rotational)
    sizes = [np.size(c.slip(time, state, still, scene.chain)) for c in scene.constraints]
    parts = np.split(np.abs(null).max(axis=1), np.cumsum(sizes)[:-1])
    names = [
        named(c)
        for c, part in zip(scene.constraints, parts, strict=True)
        if part.max(initial=0.0) > 1e-6 * np.abs(null).max()
    ]
    offset = np.asarray(slips(time, state, scene)(still)) / scale
    size = np.abs(null).T @ np.abs(offset)
    least = max(1e-8, 100 * float(np.finfo(matrix.dtype).eps))
    clash = np.any(np.abs(null.T @ offset) > least * size)
    verb = "depends" if null.shape[1] == 1 else "depend"
    how = "contradict one another" if clash else "are redundant"
    return f"{' + '.join(names)} {how}: {null.shape[1]} of their rows {verb} on the others"


def _together(state: State, scene: Scene) -> str | None:
    """Beads in one place, in words, if the mobility moves them as one."""
    if not scene.mobility.interacting:
        return None
    return coincidence(state, scene.chain, oriented=scene.oriented)


def _pushes(t: Array, state: State, scene: Scene, null: np.ndarray) -> bool:
    """Whether some multipliers, one in each column, add up to loads: not if rows are dependent."""
    pull, count = constraint_map(t, state, scene).pull, len(null)

    def squares(multipliers: np.ndarray) -> np.ndarray:
        """Sum of the squares of forces, and of torques over radii, for each column."""
        loads = jax.vmap(pull, in_axes=1)(jnp.asarray(multipliers))
        sums = np.zeros(multipliers.shape[1])
        if loads.force is not None:
            sums += np.sum(np.square(loads.force), axis=(1, 2))
        if loads.torque is not None:
            arm = np.asarray(scene.chain.radii)[None, :, None]
            sums += np.sum(np.square(np.asarray(loads.torque) / arm), axis=(1, 2))
        return sums

    alone = squares(np.eye(count, dtype=null.dtype)) @ null**2
    return bool(np.any(squares(null) > 1e-8 * alone))


def constraint_residual(t: Time, state: State, scene: Scene) -> Float[Array, ""]:
    """Norm of J Qdot + B over the number of rows and the scale of the velocities, eq. (49).

    Zero up to rounding when the multipliers do their work. The scale is the largest velocity that beads
    or their surfaces have, or would have without constraints: a fibre at rest may be held against large
    forces. Rates of turning count times the largest radius.

    >>> import jaxbeads as jb
    >>> gears, weight = jb.constraint.Gears(), jb.force.Weight([0.0, -1.0])
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), 1.0, constraints=[gears], forces=[weight])
    >>> state = jb.straight(scene.chain, [1.0, 0.0])
    >>> print(jb.dynamics.constraint_residual(0.0, state, scene) < 1e-14)
    True
    """
    if not scene.constraints:
        return jnp.zeros((), state.position.dtype)
    return _residual(jnp.asarray(t), state, scene)


@with_all_digits
@eqx.filter_jit
def _residual(t: Time, state: State, scene: Scene) -> Array:
    moved = solved(t, state, scene).evaluation.motion
    free = free_motion(t, state, scene, scene.operator(state).kept())
    radius = jnp.max(scene.chain.radius)
    both = jax.tree.leaves(((moved.velocity, free.velocity), (moved.spin, free.spin)))
    sizes = [jnp.max(jnp.abs(x)) for x in both]
    scale = jnp.max(jnp.stack([*sizes[:2], *(radius * x for x in sizes[2:])]))
    scale = jnp.where(scale == 0, 1.0, scale)
    rows = [
        jnp.ravel(c.slip(jnp.asarray(t), state, moved, scene.chain))
        / scale
        * (radius if c.turning else 1.0)
        for c in scene.constraints
    ]
    slip = jnp.concatenate(rows)
    return jnp.linalg.norm(slip) / max(slip.shape[0], 1)
