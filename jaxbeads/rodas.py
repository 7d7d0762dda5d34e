"""RODAS, a linearly implicit method of order 4 with an error estimate of order 3, stiffly accurate and
L-stable (Hairer & Wanner, Solving Ordinary Differential Equations II, ch. VI.4): its numbers, and the
factor that its stages share.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .factors import lu, triangular_solve


def _square(rows: tuple[tuple[float, ...], ...]) -> np.ndarray:
    return np.array([(*row, *[0.0] * (len(rows) - len(row))) for row in rows])


# Written for the vectors u that spare products with the Jacobian W:
# (I - h GAMMA W) u_i = GAMMA [h f(t + ALPHA_i h, y + sum A_ij u_j) + sum C_ij u_j + h^2 DRIFT_i f_t],
# y1 = y + sum A_6j u_j + u_6, and u_6 estimates the error.
GAMMA = 0.25
A = _square(
    (
        (),
        (1.544,),
        (0.9466785280815826, 0.2557011698983284),
        (3.314825187068521, 2.896124015972201, 0.9986419139977817),
        (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950),
        (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0),
    )
)
C = _square(
    (
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
)
ALPHA = np.array([0.0, 0.386, 0.21, 0.63, 1.0, 1.0])
DRIFT = np.array([0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0])


class Factor(NamedTuple):
    """I - h W/4 = D L U D^-1, rows in an order, with D of the coordinates' units."""

    matrix: Float[Array, "n n"]
    order: Int[Array, " n"]
    units: Float[Array, " n"]

    def solve(self, rhs: Array) -> Array:
        """(I - h W/4)^-1 rhs."""
        below = triangular_solve(self.matrix, (rhs / self.units)[self.order], lower=True, unit=True)
        return self.units * triangular_solve(self.matrix, below, lower=False)

    def transpose_solve(self, rhs: Array) -> Array:
        """(I - h W/4)^-T rhs."""
        above = triangular_solve(self.matrix, rhs * self.units, lower=False, transposed=True)
        found = triangular_solve(self.matrix, above, lower=True, unit=True, transposed=True)
        return found[jnp.argsort(self.order)] / self.units


def factorised(jacobian: Float[Array, "n n"], h: Array, units: Float[Array, " n"]) -> Factor:
    """I - h W/4, factorised in units of the numbers: pivots of lengths and angles must not depend on the
    unit of length.
    """
    scaled = jacobian * ((h * GAMMA / units)[:, None] * units[None, :])
    return Factor(*lu(jnp.eye(len(units), dtype=jacobian.dtype) - scaled), units)
