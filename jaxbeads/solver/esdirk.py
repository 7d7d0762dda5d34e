"""Implicit steps for stiff scenes of any size."""

import itertools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..chain import Chain
from ..coordinates import coordinates
from ..geometry import norm
from ..near import Near, Unknowns, near
from ..saddle import slips
from ..scene import Scene
from ..stages import Found, Stage, residual, solved_stage
from ..state import Load, Motion, State, zero_motion
from .base import AbstractSolver, CubicPath
from .tolerance import SAFETY, Eased, default_tolerance

# ESDIRK4(3)6L[2]SA: k_i = f(t + C_i h, y + h sum A_ij k_j), y1 = y + h sum A_6j k_j.
_GAMMA = 0.25
_A = np.array(
    [
        [0.0] * 6,
        [0.25, 0.25, 0.0, 0.0, 0.0, 0.0],
        [0.137776, -0.055776, 0.25, 0.0, 0.0, 0.0],
        [0.14463686602698217, -0.22393190761334475, 0.4492950415863626, 0.25, 0.0, 0.0],
        [
            0.09825878328356477,
            -0.5915442428196704,
            0.8101210538282996,
            0.283164405707806,
            0.25,
            0.0,
        ],
        [
            0.15791629516167136,
            0.0,
            0.18675894052400077,
            0.6805652953093346,
            -0.27524053099500667,
            0.25,
        ],
    ]
)
_C = np.array([0.0, 0.5, 0.332, 0.62, 0.85, 1.0])
_ERROR = np.array(
    [
        0.0032044943984591845,
        0.0,
        -0.002446251136679456,
        -0.021480075919587227,
        0.04394686806857245,
        -0.02322503541076487,
    ]
)
_NOT_FOUND: Any = diffrax.RESULTS.nonlinear_max_steps_reached
_ENOUGH = 0.1
"""Change of a stage, over the tolerance, below which its iterations end."""
_MANY, _MANY_COARSE = 15, 21
"""Iterations of a stage at which a step is long enough; where most are cheap."""
_LONGEST, _SHORTER = 2.0, 0.25
"""How much longer the next step may be, and how long it is where iterations do not converge."""
_WITHOUT = 1e-3
"""The tolerance where there is none, over the usual one."""


def _at_least(error: State, size: Array, fine: Array) -> State:
    """An error as large, at its largest, as said: at least, or just so where stages were not found."""
    position = jnp.where(fine, error.position, 1.0)  # of those there may be no numbers
    largest = jnp.max(norm(position))
    factor = size / jnp.where(largest > 0, largest, 1.0)
    factor = lax.stop_gradient(jnp.where(fine, jnp.maximum(1.0, factor), factor))
    return eqx.tree_at(lambda e: e.position, error, position * factor)


def _guesses() -> np.ndarray:
    """Weights of the stages before each one in its first guess: the parabola through three times (or
    what there is) that takes them least far.
    """
    table = np.zeros((6, 6))
    for i in range(1, 6):
        choices = []
        for nodes in itertools.combinations(range(i), min(i, 3)):
            at = _C[list(nodes)]
            weights = [np.prod([(_C[i] - b) / (a - b) for b in at if b != a]) for a in at]
            choices.append((max(map(abs, weights)), nodes, weights))
        _, nodes, weights = min(choices)
        table[i, list(nodes)] = weights
    return table


_GUESSES = _guesses()


class Memory(NamedTuple):
    """What goes from step to step."""

    multipliers: Float[Array, " rows"]
    """Of the last stage, where the next step begins to look for its own."""
    products: Int[Array, ""]
    """Products with the mobility, coarse ones too, of the steps that were kept."""
    moving: State
    """Rate of change of the state in the last stage, which is that of the next step's first."""
    known: Bool[Array, ""]
    """Whether there is one."""
    left_out: Motion | None
    """What coarse products leave out there, if there are any."""


class Esdirk(diffrax.AbstractAdaptiveSolver):
    """Implicit steps of order 4 with an error estimate of order 3, L-stable and stiffly accurate: the
    method ESDIRK4(3)6L[2]SA of Kennedy & Carpenter, Appl. Numer. Math. 44 (2003) 139.

    A step has five implicit stages, each solved with its multipliers by iterations that take a product
    with the mobility each (`stages`), and never the whole of a matrix; of large scenes most are coarse,
    and what these leave out goes from stage to stage. It works in `coordinates`, so
    that bonds keep their lengths at any step.

    **Argument**: `tolerance` of a step, over the longest fibre's length; iterations end at a tenth.
    """

    tolerance: Float[Array, ""] | None = None

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., Any]] = CubicPath

    def order(self, terms: PyTree) -> int:
        """4."""
        return 4

    def error_order(self, terms: PyTree) -> int:
        """4: the error estimate falls like h^4."""
        return 4

    def init(self, terms: Any, t0: Any, t1: Any, y0: State, args: Scene) -> Memory:
        """No multipliers yet."""
        none, still = jnp.zeros((0,), y0.position.dtype), zero_motion(y0, args.rotational)
        if args.constraints:
            none = jnp.zeros_like(slips(jnp.asarray(t0), y0, args)(still))
        moving, left_out = jax.tree.map(jnp.zeros_like, y0), None
        any_load, operator = Load(still.velocity, still.spin), args.operator(y0)
        if jax.eval_shape(lambda: operator.coarse(any_load)) is not None:
            left_out = still
        return Memory(none, jnp.zeros((), int), moving, jnp.zeros((), bool), left_out)

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: State,
        args: Scene,
        solver_state: Memory,
        made_jump: Any,
    ) -> tuple[State, State, dict, Memory, diffrax.RESULTS]:
        """One step from t0 to t1."""
        chart, t0 = coordinates(args, y0), jnp.asarray(t0)
        h = t1 - t0
        dtype = y0.position.dtype
        tolerance = self.tolerance
        if tolerance is None:
            rounding = 1000 * float(jnp.finfo(dtype).eps)
            tolerance = max(_WITHOUT * default_tolerance(dtype), rounding)
        enough = _ENOUGH * jnp.asarray(tolerance, dtype)
        before = lax.stop_gradient(solver_state.multipliers)
        left_out_before = lax.stop_gradient(solver_state.left_out)
        # What was found at the end of the step before is less rough than what its state asks for, of
        # which it is as accurate as iterations are, and costs nothing.
        known = solver_state.known & ~jnp.asarray(made_jump)
        begun = chart.rate(chart.origin, chart.start, solver_state.moving)

        def about(t: Array, x: Array, multipliers: Array, implicit: bool = True) -> Near:
            given = lax.stop_gradient((t, x, _GAMMA * h, chart, args, multipliers))
            return near(*given, implicit)

        def stage(found: tuple[Any, ...], row: Any) -> tuple[Any, None]:
            rates, multipliers, fine, products, most, close, left_out = found
            index, a, c, ahead, weights = row
            at = Stage(t0 + c * h, h * (a @ rates), h * ahead)

            def guessed(every: Any, last: Any) -> Any:
                from_all = jax.tree.map(lambda x: jnp.tensordot(weights, x, 1), every)
                return jax.tree.map(lambda x, y: jnp.where(index == 0, y, x), from_all, last)

            guess = Unknowns(weights @ rates, guessed(multipliers, before))
            thought = guessed(left_out, left_out_before)
            # All implicit stages are solved about the middle of the step, where its begin leads.
            close = lax.cond(
                index == 1,
                lambda: about(t0 + 0.5 * h, 0.5 * h * rates[0], multipliers[0]),
                lambda: close,
            )
            # Nothing is asked for where the first stage is known, or one before was not found and the
            # step will be tried again.
            first, again = (index == 0) & known, ~fine & (self.tolerance is not None)
            idle = Unknowns(jnp.where(first, begun, guess.rate), guess.multipliers)
            solved = lax.cond(
                first | again,
                lambda: Found(idle, fine, jnp.zeros((), int), thought),
                lambda: solved_stage(at, h, chart, args, close, guess, enough, thought),
            )
            rates = rates.at[index].set(solved.unknowns.rate)
            multipliers = multipliers.at[index].set(lax.stop_gradient(solved.unknowns.multipliers))
            fine, products = fine & solved.fine, products + solved.products
            most = jnp.maximum(most, jnp.where(index > 0, solved.products, 0))
            left_out = jax.tree.map(lambda x, v: x.at[index].set(v), left_out, solved.left_out)
            return (rates, multipliers, fine, products, most, close, left_out), None

        none = jnp.zeros((6, len(chart.origin)), dtype), jnp.zeros((6, len(before)), dtype)
        rows = (_A - np.diag(np.diag(_A)), _C, np.diag(_A), _GUESSES)
        table = (jnp.arange(6), *(jnp.asarray(x, dtype) for x in rows))

        def start() -> tuple[Near, Array, Array]:
            close = about(t0, chart.origin, before, implicit=False)
            # One iteration more, after which it is known how large multipliers are.
            unknown = Unknowns(jnp.zeros_like(chart.origin), before)
            here = lax.stop_gradient(Stage(t0, chart.origin, 0 * h))
            off = residual(here, unknown, *lax.stop_gradient((chart, args)))
            more = close.answer(off, jnp.asarray(False)).multipliers
            return close, before + more, jnp.ones((), int)

        shapes = eqx.filter_eval_shape(start)
        idle = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        close, before, more = lax.cond(known, lambda: (idle[0], before, idle[2]), start)
        # A loop, so that a stage is compiled once.
        products = solver_state.products + more
        every = jax.tree.map(lambda v: jnp.zeros((6, *v.shape), v.dtype), left_out_before)
        first = (*none, jnp.asarray(True), products, jnp.zeros((), int), close, every)
        found, _ = lax.scan(stage, first, table)
        rates, multipliers, fine, products, most, _, left_out = found
        if self.tolerance is not None:
            # Of a step that will be tried again nothing is known, also not on its way.
            rates = jnp.where(fine, rates, 0.0)
        x1 = h * (jnp.asarray(_A[5], dtype) @ rates)
        error = h * (jnp.asarray(_ERROR, dtype) @ rates)
        y1, other = chart.state(x1), chart.state(x1 - error)
        off = jax.tree.map(lambda a, b: a - b, y1, other)
        if self.tolerance is not None:
            # What iterations find hard is told as an error: the next step is longer by no more than
            # they allow, and one in which they did not converge is taken again.
            many = _MANY if left_out is None else _MANY_COARSE
            allowed = jnp.clip(many / most.astype(dtype), 0.95, _LONGEST)
            allowed = jnp.where(fine, allowed, _SHORTER)
            least = tolerance * jnp.max(args.chain.length) * (SAFETY / allowed) ** 4
            off = _at_least(off, lax.stop_gradient(least), fine)
            fine = fine | (jnp.max(jnp.abs(off.position)) > 0)  # else nothing tells it
        begin, end = h * rates[0], h * rates[5]
        bend = jnp.stack([begin - x1, 2 * x1 - begin - end])
        dense = {"coordinates": chart, "x1": x1, "bend": bend}
        result = diffrax.RESULTS.where(fine, diffrax.RESULTS.successful, _NOT_FOUND)
        moving = jax.jvp(chart.state, (x1,), (rates[5],))[1]
        left_out = jax.tree.map(lambda v: lax.stop_gradient(v[5]), left_out)
        memory = Memory(multipliers[5], products, moving, jnp.asarray(True), left_out)
        return y1, off, dense, memory, result

    def func(self, terms: Any, t0: Any, y0: State, args: Scene) -> State:
        """The right-hand side."""
        return terms.vf(t0, y0, args)


class ESDIRK(AbstractSolver):
    """Implicit steps for stiff scenes of any size, as `ESDIRK(tolerance=1e-5)`: the scheme `Esdirk`.

    For many fibres, and long ones, that `Rosenbrock` cannot hold as one matrix. The error over a path is
    ten to forty times the tolerance, and more for fibres that slide over one another.

    **Arguments**, by name: as for `AbstractSolver`.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> scene = jb.Scene(chain, 1.0, jb.mobility.FreeDraining(), forces=[jb.force.Spring(1e6)])
    >>> stretched, ts = jb.State([[0.0, 0.0], [2.5, 0.0]]), [0.0, 100.0]
    >>> solution = jb.rollout(scene, stretched, ts, solver=jb.ESDIRK(tolerance=1e-6))
    >>> apart = jb.observables.end_to_end_distance(solution.final.position)
    >>> print(f"{apart:.4f}", solution.steps < 100)
    2.0000 True
    """

    keeps_bonds: ClassVar[bool] = True
    implicit: ClassVar[bool] = True
    evaluations: ClassVar[float] = 5

    @property
    def scheme(self) -> Esdirk:
        """Of order 4, as accurate as asked."""
        return Esdirk(self.tolerance)

    def controlled(self, tolerance: Float[Array, ""], chain: Chain) -> Eased:
        """Few steps are taken again, for each has a matrix of its own."""
        return Eased(tolerance, jnp.max(chain.length))
