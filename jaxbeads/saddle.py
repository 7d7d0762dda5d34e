"""The saddle-point system of one instant: constraints as linear maps, S = J M J^T, its solution."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ._checks import fail
from .constraint import AbstractChainConstraint, AbstractConstraint
from .factors import cholesky, cholesky_solve, diagonal
from .iterations import conjugate_gradients
from .mobility import Operator, Product
from .pairs import PairTensor
from .scene import Scene
from .state import Load, Motion, State, add_motions, zero_motion
from .windows import Banded, Blocks, parts

Time = Float[Array, ""] | float

MOST_OTHERS = 1000
"""Rows of S beside those of the chain constraint that iterations can carry."""


class Evaluation(NamedTuple):
    """What one instant yields."""

    motion: Motion
    multipliers: Array
    """Lagrange multipliers of all constraints in turn, raveled [force]."""


def slips(t: Time, state: State, scene: Scene) -> Callable[[Motion], Array]:
    """All constraints' residuals as one vector; affine in the motion."""

    def slip(motion: Motion) -> Array:
        rows = (c.slip(jnp.asarray(t), state, motion, scene.chain) for c in scene.constraints)
        return jnp.concatenate([jnp.ravel(row) for row in rows])

    return slip


class ConstraintMap(NamedTuple):
    """J as a pair of linear functions."""

    slip: Callable[[Motion], Array]  # J Qdot + B
    linear: Callable[[Motion], Array]  # J Qdot, without a B that might drown it
    offset: Array  # B
    pull: Callable[[Array], Load]  # J^T lambda

    def compliance(self, operator: Product, multipliers: Array) -> Array:
        """J M J^T lambda."""
        return self.linear(operator.motion(self.pull(multipliers)))


def constraint_map(t: Time, state: State, scene: Scene) -> ConstraintMap:
    """J, J^T and B of all constraints at one instant."""
    slip = slips(t, state, scene)
    still = zero_motion(state, scene.rotational)
    offset, transpose = jax.vjp(slip, still)

    def linear(motion: Motion) -> Array:
        return jax.jvp(slip, (still,), (motion,))[1]

    def pull(multipliers: Array) -> Load:
        (pulled,) = transpose(multipliers)
        return Load(pulled.velocity, pulled.spin)

    return ConstraintMap(slip, linear, offset, pull)


def _size(t: Time, state: State, scene: Scene, constraint: AbstractConstraint) -> int:
    """Rows of a constraint."""
    still = zero_motion(state, scene.rotational)
    return np.size(constraint.slip(jnp.asarray(t), state, still, scene.chain))


def _chained(
    t: Time, state: State, scene: Scene
) -> tuple[AbstractChainConstraint, int] | tuple[None, int]:
    """The chain constraint, wherever it stands, and the number of its first row."""
    first = 0
    for constraint in scene.constraints:
        if isinstance(constraint, AbstractChainConstraint):
            return constraint, first
        first += _size(t, state, scene, constraint)
    return None, 0


def chained_rows(t: Time, state: State, scene: Scene) -> tuple[int, int]:
    """Rows of the chain constraint, from and to."""
    constraint, first = _chained(t, state, scene)
    return first, first if constraint is None else first + _size(t, state, scene, constraint)


def matrix(t: Time, state: State, scene: Scene, operator: Product) -> Array:
    """S = J M J^T, its upper triangle.

    The chain constraint assembles its own block where it can. All other columns are found by applying
    M to one unit multiplier after the other, vectorised.
    """
    j = constraint_map(t, state, scene)
    rows, (constraint, first) = j.offset.shape[0], _chained(t, state, scene)
    block = None
    if constraint is not None and isinstance(operator, PairTensor):
        block = constraint.assemble(jnp.asarray(t), state, operator, scene.chain)
    last = first if block is None else first + block.shape[0]
    others = np.array([*range(first), *range(last, rows)], int)
    units = jnp.eye(rows, dtype=j.offset.dtype)[others]
    rest = jax.vmap(lambda unit: j.compliance(operator, unit))(units)
    # Rows that read no motion (as those of a chain constraint between two fibres) stay regular.
    empty = rest[np.arange(len(others)), others] == 0
    rest = jnp.where(empty[:, None], units, rest)
    if block is None or len(rest) == 0:
        return rest if block is None else block
    # Rows before the chain's are whole; of those after it only the upper triangle is asked for.
    middle = jnp.concatenate(
        [jnp.pad(block, ((0, rows - last), (0, 0))), rest[first:, first:].T], axis=1
    )
    if first == 0:
        return middle
    return jnp.concatenate([rest[:first], jnp.pad(middle, ((0, 0), (first, 0)))])


Compliance = Callable[[Array], Array]


class Factorised(NamedTuple):
    """S, factorised."""

    factor: Array
    regular: Array
    """Whether the rows of J are independent."""

    def solve(self, _: Compliance, rhs: Array) -> Array:
        """S^-1 rhs; NaN where S is singular."""
        return cholesky_solve(self.factor, jnp.where(self.regular, rhs, jnp.nan))


class Iterations(eqx.Module):
    """S as a product, with S' = J M' J^T for a preconditioner (see `windows`): the block of the chain
    constraint banded, all other rows eliminated against it.
    """

    chain: Banded | Blocks | None
    coupling: Float[Array, "others chained"]
    response: Float[Array, "chained others"]
    factor: Float[Array, "others others"]
    place: tuple[int, int] = eqx.field(static=True)
    """Rows of the chain constraint, from and to."""

    def solve(self, product: Compliance, rhs: Array) -> Array:
        """S^-1 rhs; NaN where the iterations do not converge."""
        return conjugate_gradients(product, rhs, self.precondition).solution

    def precondition(self, residual: Array) -> Array:
        """S'^-1 r."""
        first, last = self.place
        others = jnp.concatenate([residual[:first], residual[last:]])
        chained = residual[first:last]
        if self.chain is not None:
            chained = self.chain.solve(chained)
        if len(others) == 0:
            return chained
        others = cholesky_solve(self.factor, others - self.coupling @ chained)
        chained = chained - self.response @ others
        return jnp.concatenate([others[:first], chained, others[first:]])


def _factorised(t: Time, state: State, scene: Scene, operator: Product) -> Factorised:
    s = matrix(t, state, scene, operator)
    factor, positive = cholesky(s)
    # A row that depends on those before it leaves a pivot of rounding size, or none.
    pivot = diagonal(factor) ** 2 / diagonal(s)
    regular = jnp.min(pivot, initial=1.0) > 10 * len(pivot) * jnp.finfo(pivot.dtype).eps
    return Factorised(factor, regular & positive)


def iterations(t: Time, state: State, scene: Scene) -> Iterations:
    """S' of one instant."""
    windows = parts(state, scene.operator(state), scene.chain)
    j = constraint_map(t, state, scene)
    still, rows = zero_motion(state, scene.rotational), len(j.offset)
    constraint, first = _chained(t, state, scene) if scene.chain.beads > 1 else (None, 0)
    banded, last = None, first
    if constraint is not None:
        banded = windows.factor(jnp.asarray(t), constraint)
        last = first + _size(t, state, scene, constraint)
    others = np.r_[:first, last:rows]
    if len(others) > MOST_OTHERS:
        must = f"have at most {MOST_OTHERS} rows beside a chain's where the mobility is not dense"
        fail(
            "scene.constraints", must, f"they have {len(others)} (`RPY(dense=True)` makes it dense)"
        )

    def row(index: Array) -> Array:
        unit = jnp.zeros(rows, j.offset.dtype).at[index].set(1.0)
        return j.linear(windows.motion(j.pull(unit), still))

    whole = lax.map(row, jnp.asarray(others, int)) if len(others) else jnp.zeros((0, rows))
    coupling, factor = whole[:, first:last], whole[:, others]
    empty = jnp.diagonal(factor) == 0
    factor = factor + jnp.diag(empty * 1.0)
    response = coupling.T
    if banded is not None and len(others):
        response = jax.vmap(banded.solve, out_axes=1)(coupling)
    factor, positive = cholesky(factor - coupling @ response)
    factor = jnp.where(positive, factor, jnp.nan)
    return Iterations(banded, coupling, response, factor, (first, last))


class SaddlePoint(NamedTuple):
    """The saddle-point system of one instant, ready to be solved."""

    operator: Product
    constraints: ConstraintMap
    solver: Factorised | Iterations

    def multipliers(self, slip: Array) -> Array:
        """-S^-1 slip; NaN where S is singular."""
        if slip.size == 0:  # as one bead under `Gears`
            return -slip

        def compliance(x: Array) -> Array:
            return self.constraints.compliance(self.operator, x)

        operator = self.operator
        if not isinstance(operator, Operator):
            solve = self.solver.solve
            return lax.custom_linear_solve(compliance, -slip, solve, symmetric=True)
        held = lax.stop_gradient(operator)

        def product(x: Array) -> Array:
            return self.constraints.linear(held.product(self.constraints.pull(x)))

        def iterated(_: Compliance, rhs: Array) -> Array:
            return self.solver.solve(product, rhs)

        return lax.custom_linear_solve(compliance, -slip, iterated, symmetric=True)

    def pulled(self, multipliers: Array) -> Motion:
        """M J^T lambda."""
        return self.operator.motion(self.constraints.pull(multipliers))

    def hold(self, free: Motion) -> Evaluation:
        """The motion without constraints made to meet them."""
        multipliers = self.multipliers(self.constraints.slip(free))
        return Evaluation(add_motions(free, self.pulled(multipliers)), multipliers)


def saddle_point(t: Time, state: State, scene: Scene, operator: Product) -> SaddlePoint:
    """The system of multipliers at one instant, S factorised or ready to be iterated."""
    held = lax.stop_gradient(operator)
    instant = lax.stop_gradient((t, state, scene))
    solver = _factorised(*instant, held) if scene.dense else iterations(*instant)
    return SaddlePoint(operator, constraint_map(t, state, scene), solver)
