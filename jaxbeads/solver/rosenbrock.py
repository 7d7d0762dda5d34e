"""Linearly implicit steps for stiff scenes."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

from ..dynamics import rate
from ..linearise import linearise
from ..scene import Scene
from ..state import State, ravel, unravel

# RODAS, written for the vectors u that spare products with the Jacobian W:
# (I - h GAMMA W) u_i = GAMMA [h f(t + ALPHA_i h, y + sum A_ij u_j) + sum C_ij u_j + h^2 DRIFT_i f_t].
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


def _square(rows: tuple[tuple[float, ...], ...]) -> np.ndarray:
    return np.array([(*row, *[0.0] * (len(rows) - len(row))) for row in rows])


class Rosenbrock(diffrax.AbstractAdaptiveSolver):
    """Linearly implicit steps of order 4 with an error estimate of order 3, stiffly accurate and
    L-stable: the method RODAS of Hairer & Wanner, Solving Ordinary Differential Equations II, ch. VI.4.

    No iteration: a step takes one exact linearisation of the scene (`linearise`), one factorisation
    I - h W/4 = L U and six evaluations of the rate. Its length is bound by the accuracy asked for, not by
    the fastest bending rate, which an explicit step must resolve. Time-dependent scenes keep the order.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., Any]] = (
        diffrax.ThirdOrderHermitePolynomialInterpolation
    )

    def order(self, terms: PyTree) -> int:
        """4."""
        return 4

    def error_order(self, terms: PyTree) -> int:
        """4: the error estimate behaves like h^4."""
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
        h, start, about = t1 - t0, ravel(y0), linearise(t0, y0, args)
        solve = _factorised(jnp.eye(len(start)) - h * _GAMMA * about.jacobian)
        drift = h * h * about.drift

        def stage(us: Array, row: tuple[Array, ...]) -> tuple[Array, None]:
            index, a, c, alpha, weight = row
            f = ravel(rate(t0 + alpha * h, unravel(start + a @ us, y0), args))
            return us.at[index].set(solve(_GAMMA * (h * f + c @ us + weight * drift))), None

        us = jnp.zeros((6, len(start)), start.dtype)
        us = us.at[0].set(solve(_GAMMA * (h * about.rate + _DRIFT[0] * drift)))
        # A loop, so that the rate is compiled once.
        rows = [np.asarray(x, start.dtype)[1:] for x in (_square(_A), _square(_C), _ALPHA, _DRIFT)]
        us, _ = lax.scan(stage, us, (np.arange(1, 6), *rows))
        y1 = unravel(start + np.asarray(_square(_A)[5], start.dtype) @ us + us[5], y0)
        k0 = unravel(h * about.rate, y0)
        k1 = jax.tree.map(lambda k: h * k, rate(t1, y1, args))
        dense = {"y0": y0, "y1": y1, "k0": k0, "k1": k1}
        return y1, unravel(us[5], y0), dense, None, diffrax.RESULTS.successful

    def func(self, terms: Any, t0: Any, y0: State, args: Scene) -> State:
        """The right-hand side."""
        return terms.vf(t0, y0, args)


def _factorised(matrix: Array) -> Callable[[Array], Array]:
    """Solutions with one LU factor, which derivatives reuse."""
    factor = jax.scipy.linalg.lu_factor(lax.stop_gradient(matrix))

    def solve(rhs: Array) -> Array:
        return lax.custom_linear_solve(
            lambda x: matrix @ x,
            rhs,
            lambda _, b: jax.scipy.linalg.lu_solve(factor, b),
            lambda _, b: jax.scipy.linalg.lu_solve(factor, b, trans=1),
        )

    return solve
