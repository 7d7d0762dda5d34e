"""Linearly implicit steps for stiff scenes."""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

from ..coordinates import Coordinates, coordinates
from ..factors import lu, triangular_solve
from ..linearise import coordinate_rate, linearise
from ..scene import Scene
from ..state import State

# RODAS, written for the vectors u that spare products with the Jacobian W:
# (I - h GAMMA W) u_i = GAMMA [h f(t + ALPHA_i h, y + sum A_ij u_j) + sum C_ij u_j + h^2 DRIFT_i f_t],
# y1 = y + sum A_6j u_j + u_6, and u_6 estimates the error.
_GAMMA = 0.25
_A = (
    (),
    (1.544,),
    (0.9466785280815826, 0.2557011698983284),
    (3.314825187068521, 2.896124015972201, 0.9986419139977817),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0),
)
_C = (
    (),
    (-5.6688,),
    (-2.430093356833875, -0.2063599157091915),
    (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
    (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
    (
        8.083246795921522,
        -7.981132988064893,
        -31.52159432874371,
        16.31930543123136,
        -6.058818238834054,
    ),
)
_ALPHA = (0.0, 0.386, 0.21, 0.63, 1.0, 1.0)
_DRIFT = (0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0)
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


def _square(rows: tuple[tuple[float, ...], ...]) -> np.ndarray:
    return np.array([(*row, *[0.0] * (len(rows) - len(row))) for row in rows])


class _Interpolation(diffrax.AbstractLocalInterpolation):
    """States between the ends of a step: a cubic in the coordinates."""

    t0: Any
    t1: Any
    coordinates: Coordinates
    x1: Array
    bend: Array

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> Any:
        """State at t0, or its change from t0 to t1."""
        if t1 is not None:
            return jax.tree.map(lambda a, b: b - a, self.evaluate(t0), self.evaluate(t1))
        s = (t0 - self.t0) / (self.t1 - self.t0)
        first, second = self.bend
        return self.coordinates.state(s * (self.x1 + (1 - s) * (first + s * second)))


class Rosenbrock(diffrax.AbstractAdaptiveSolver):
    """Linearly implicit steps of order 4 with an error estimate of order 3, stiffly accurate and
    L-stable: the method RODAS of Hairer & Wanner, Solving Ordinary Differential Equations II, ch. VI.4.

    No iteration: a step takes one exact linearisation of the scene (`linearise`), one factorisation
    I - h W/4 = L U and five evaluations of the rate. Its length is bound by the accuracy asked for, not
    by the fastest bending rate, which an explicit step must resolve. It works in `coordinates`, so that
    bonds keep their lengths at any step. Time-dependent scenes keep the order.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., Any]] = _Interpolation
    hopeless: ClassVar[Any] = diffrax.RESULTS.singular
    """The result where the linearisation at the start of a step is not finite: none smaller mends it."""

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
        about, x0 = linearise(t0, chart, args, frozen=True), chart.origin

        # Derivatives of a solution need those of W along the solution only.
        _, along = jax.linearize(lambda x: coordinate_rate(t0, x, chart, args), x0)

        def implicit(u: Array) -> Array:
            """(I - h W/4) u."""
            return u - h * _GAMMA * along(u)

        # In units of their own: the pivots of lengths and angles must not depend on the unit of length.
        units = lax.stop_gradient(chart.units)
        scaled = about.jacobian * ((h * _GAMMA / units)[:, None] * units[None, :])
        matrix = jnp.eye(len(x0), dtype=x0.dtype) - scaled
        solve_scaled = _factorised(lambda u: implicit(units * u) / units, matrix)

        def solve(rhs: Array) -> Array:
            return units * solve_scaled(rhs / units)

        drift = h * h * about.drift

        def stage(us: Array, row: tuple[Array, ...]) -> tuple[Array, None]:
            index, a, c, alpha, weight = row
            f = coordinate_rate(t0 + alpha * h, a @ us, chart, args)
            return us.at[index].set(solve(_GAMMA * (h * f + c @ us + weight * drift))), None

        us = jnp.zeros((6, len(x0)), x0.dtype)
        us = us.at[0].set(solve(_GAMMA * (h * about.rate + _DRIFT[0] * drift)))
        # A loop, so that the rate is compiled once.
        a, c = _square(_A), _square(_C)
        rows = [jnp.asarray(row[1:], x0.dtype) for row in (a, c, _ALPHA, _DRIFT)]
        us, _ = lax.scan(stage, us, (jnp.arange(1, 6), *rows))
        x1 = jnp.asarray(a[5], x0.dtype) @ us + us[5]
        y1, other = chart.state(x1), chart.state(x1 - us[5])
        error = jax.tree.map(lambda a, b: a - b, y1, other)
        bend = jnp.asarray(_DENSE, x0.dtype) @ us
        dense = {"coordinates": chart, "x1": x1, "bend": bend}
        finite = jnp.array([jnp.all(jnp.isfinite(part)) for part in about])
        result = diffrax.RESULTS.where(jnp.all(finite), diffrax.RESULTS.successful, self.hopeless)
        return y1, error, dense, None, result

    def func(self, terms: Any, t0: Any, y0: State, args: Scene) -> State:
        """The right-hand side."""
        return terms.vf(t0, y0, args)


def _factorised(product: Callable[[Array], Array], matrix: Array) -> Callable[[Array], Array]:
    """Solutions of product(x) = rhs with one LU factor of the matrix, which derivatives reuse: they are
    those of the product, which is taken only where something is differentiated."""
    factor, order = lu(lax.stop_gradient(matrix))
    back = jnp.argsort(order)
    lower = partial(triangular_solve, factor, lower=True, unit=True)
    upper = partial(triangular_solve, factor, lower=False)

    def solve(_: Callable[[Array], Array], rhs: Array) -> Array:
        return upper(lower(rhs[order]))

    def transpose_solve(_: Callable[[Array], Array], rhs: Array) -> Array:
        return lower(upper(rhs, transposed=True), transposed=True)[back]

    return lambda rhs: lax.custom_linear_solve(product, rhs, solve, transpose_solve)
