"""Linearly implicit steps for stiff scenes."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from .. import rodas
from .._typing import with_all_digits
from ..coordinates import AbstractCoordinates, coordinates
from ..instant import Solved, solved
from ..linearise import coordinate_derivative, coordinate_rate, linearise
from ..loops import keep
from ..scene import Scene
from ..state import State
from .base import AbstractSolver, CubicPath

# Between the ends, y(t + s h) = y + s [y1 - y + (1 - s) (D_1 u + s D_2 u)].
_DENSE = (
    (
        10.12623508344586,
        -7.487995877610167,
        -34.80091861555747,
        -7.992771707568823,
        1.025137723295662,
        0.0,
    ),
    (
        -0.6762803392806898,
        6.087714651680015,
        16.43084320892478,
        24.76722511418386,
        -6.594389125716872,
        0.0,
    ),
)

_SINGULAR: Any = diffrax.RESULTS.singular
"""The result where the linearisation at the start of a step is not finite: none smaller mends it."""


class Rodas(diffrax.AbstractAdaptiveSolver):
    """Linearly implicit steps of order 4 with an error estimate of order 3, stiffly accurate and
    L-stable: the method RODAS of Hairer & Wanner, Solving Ordinary Differential Equations II, ch. VI.4.

    No iteration: a step takes one exact linearisation of the scene (`linearise`), one factorisation
    I - h W/4 = L U and five evaluations of the rate. Its length is bound by the accuracy asked for, not
    by the fastest bending rate, which an explicit step must resolve. It works in `coordinates`, so that
    bonds keep their lengths at any step. Time-dependent scenes keep the order.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., Any]] = CubicPath

    def order(self, terms: PyTree) -> int:
        """4."""
        return 4

    def error_order(self, terms: PyTree) -> int:
        """4: the error estimate falls like h^4."""
        return 4

    def init(self, terms: Any, t0: Any, t1: Any, y0: State, args: Scene) -> None:
        """Nothing is carried from step to step."""
        return None

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: State,
        args: Scene,
        solver_state: None,
        made_jump: Any,
    ) -> tuple[State, State, dict, None, diffrax.RESULTS]:
        """One step from t0 to t1."""
        chart, h = coordinates(args, y0), t1 - t0
        us, finite = _stages(t0, h, chart, args)[:2]
        x1 = jnp.asarray(rodas.A[5, :5], us.dtype) @ us[:5] + us[5]
        y1, other = chart.state(x1), chart.state(x1 - us[5])
        error = jax.tree.map(lambda a, b: a - b, y1, other)
        bend = jnp.asarray(_DENSE, us.dtype) @ us
        dense = {"coordinates": chart, "x1": x1, "bend": bend}
        result = diffrax.RESULTS.where(finite, diffrax.RESULTS.successful, _SINGULAR)
        return y1, error, dense, None, result

    def func(self, terms: Any, t0: Any, y0: State, args: Scene) -> State:
        """The right-hand side."""
        return terms.vf(t0, y0, args)


class Rosenbrock(AbstractSolver):
    """Linearly implicit steps for stiff scenes, as `Rosenbrock(tolerance=1e-6)`: the scheme `Rodas`.

    **Arguments**, by name: as for `AbstractSolver`.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> scene = jb.Scene(chain, 1.0, jb.mobility.FreeDraining(), forces=[jb.force.Spring(1e6)])
    >>> stretched, ts = jb.State([[0.0, 0.0], [2.5, 0.0]]), [0.0, 100.0]
    >>> solution = jb.rollout(scene, stretched, ts, solver=jb.Rosenbrock(tolerance=1e-6))
    >>> apart = jb.observables.end_to_end_distance(solution.final.position)
    >>> print(f"{apart:.4f}", solution.steps < 100)
    2.0000 True
    """

    keeps_bonds: ClassVar[bool] = True
    needs_matrix: ClassVar[bool] = True
    implicit: ClassVar[bool] = True
    hopeless: ClassVar[Any] = _SINGULAR
    evaluations: ClassVar[float] = 25

    @property
    def scheme(self) -> Rodas:
        """Of order 4."""
        return Rodas()


class _Stages(NamedTuple):
    """Of one step."""

    us: Float[Array, "stages n"]
    finite: Bool[Array, ""]
    """Whether the linearisation is."""
    factor: rodas.Factor
    instants: Solved
    """The stages', stacked. Like the factor a constant to all derivatives."""


def _rows(dtype: Any) -> tuple[Array, ...]:
    """For each stage its number, and A, C, ALPHA, DRIFT."""
    table = rodas.A, rodas.C, rodas.ALPHA, rodas.DRIFT
    return (jnp.arange(6), *(jnp.asarray(row, dtype) for row in table))


@eqx.filter_custom_jvp
def _stages(t0: Array, h: Array, chart: AbstractCoordinates, scene: Scene) -> _Stages:
    """The vectors u of a step from the origin of a chart."""
    return _solved(t0, h, chart, scene)


@with_all_digits
@eqx.filter_jit
def _solved(t0: Array, h: Array, chart: AbstractCoordinates, scene: Scene) -> _Stages:
    about, x0 = linearise(t0, chart, scene), chart.origin
    jacobian, slope = about.jacobian(), about.time_derivative
    # In units of their own: the pivots of lengths and angles must not depend on the unit of length.
    units = chart.units
    factor = rodas.factorised(jacobian, h, units)
    drift = h * h * slope

    def stage(us: Array, row: tuple[Array, ...]) -> tuple[Array, Solved]:
        index, a, c, alpha, weight = row
        t, x = t0 + alpha * h, a @ us
        known = solved(t, chart.state(x), scene)
        f = coordinate_rate(t, x, chart, scene, known)
        rhs = rodas.GAMMA * (h * f + c @ us + weight * drift)
        return us.at[index].set(factor.solve(rhs)), known

    us = jnp.zeros((6, len(x0)), x0.dtype)
    first = h * about.rate + float(rodas.DRIFT[0]) * drift
    us = us.at[0].set(factor.solve(rodas.GAMMA * first))
    # A loop, so that the rate is compiled once.
    us, later = lax.scan(stage, us, jax.tree.map(lambda x: x[1:], _rows(x0.dtype)))
    instants = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), about.known, later)
    finite = jnp.array([jnp.all(jnp.isfinite(part)) for part in (about.rate, slope, jacobian)])
    return _Stages(us, jnp.all(finite), factor, instants)


@_stages.def_jvp
@with_all_digits
def _stages_jvp(primals: Any, tangents: Any) -> tuple[_Stages, _Stages]:
    """With G_i = f'(t0, x0) (h DRIFT_i, u_i), the derivative of f along a stage, dots for derivatives by
    all that is given, and G_i* for that of G_i with u_i held:

        (I - h GAMMA W) u_i* = GAMMA [h* (f_i + G_i) + h f_i* + sum C_ij u_j* + h G_i*].

    So the Jacobian's columns are not differentiated, and the factor serves here too.
    """
    t0, h, chart, scene = primals
    found = keep(_stages(*primals))
    us, x0, factor, instants = found.us, chart.origin, found.factor, found.instants
    first = jax.tree.map(lambda x: x[0], instants)

    def along(t0: Array, h: Array, chart: AbstractCoordinates, scene: Scene) -> Array:
        """G, all stages."""
        shifts = h * jnp.asarray(rodas.DRIFT, x0.dtype), us
        return jax.vmap(lambda s: coordinate_derivative(t0, chart, scene, first, s))(shifts)

    def implicit(u: Array) -> Array:
        """(I - h W/4) u."""
        return u - h * rodas.GAMMA * coordinate_derivative(t0, chart, scene, first, (0 * t0, u))

    def solve(rhs: Array) -> Array:
        return lax.custom_linear_solve(
            implicit,
            rhs,
            lambda _, b: factor.solve(b),
            lambda _, b: factor.transpose_solve(b),
        )

    g, g_moved = eqx.filter_jvp(along, primals, tangents)
    longer = jnp.zeros_like(h) if tangents[1] is None else tangents[1]
    fixed = longer * g + h * (jnp.zeros_like(g) if g_moved is None else g_moved)

    def stage(moved: Array, row: Any) -> tuple[Array, None]:
        (index, a, c, alpha, _), fixed, known = row

        def rate(x: Array, t0: Array, h: Array, chart: AbstractCoordinates, scene: Scene) -> Array:
            return coordinate_rate(t0 + alpha * h, x, chart, scene, known)

        f, f_moved = eqx.filter_jvp(rate, (a @ us, *primals), (a @ moved, *tangents))
        rhs = longer * f + h * f_moved + c @ moved + fixed
        return moved.at[index].set(solve(rodas.GAMMA * rhs)), None

    moved, _ = lax.scan(stage, jnp.zeros_like(us), (_rows(x0.dtype), fixed, instants))
    constant = jax.tree.map(lambda _: None, (factor, instants))
    no: Any = None
    return found, _Stages(moved, no, *constant)
