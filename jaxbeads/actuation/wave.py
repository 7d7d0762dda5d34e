"""Travelling wave of preferred curvature."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail, finite, shape
from .._typing import float_array
from .base import AbstractCurvature


class TravellingWave(AbstractCurvature):
    """kappa_0(s, t) = A sin(k s - 2 pi f t + phi).

    **Arguments**

    - `amplitude`: A [1/length], one for all joints or one each, `(joints,)`.
    - `wavenumber`: k [1/length]; the wave runs to larger s for k > 0 (f > 0).
    - `frequency`: f [1/time].
    - `phase`: phi [rad], one for all joints or one each.

    **Raises** `ValueError` for other shapes and numbers that are not finite.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.actuation import TravellingWave
    >>> wave = TravellingWave(amplitude=0.1, wavenumber=jnp.pi / 4, frequency=1.0)
    >>> print(wave(jnp.zeros(()), jnp.array([2.0, 4.0]), jnp.array([8.0, 8.0])).round(4))
    [0.1 0. ]
    """

    amplitude: Array = eqx.field(converter=float_array)
    wavenumber: Float[Array, ""] = eqx.field(converter=float_array)
    frequency: Float[Array, ""] = eqx.field(converter=float_array)
    phase: Array = eqx.field(converter=float_array)

    def __init__(self, amplitude: Any, wavenumber: Any, frequency: Any, phase: Any = 0.0) -> None:
        self.amplitude = float_array(amplitude)
        self.wavenumber = float_array(wavenumber)
        self.frequency = float_array(frequency)
        self.phase = float_array(phase)

    def __check_init__(self) -> None:
        for name in ("amplitude", "phase"):
            value = getattr(self, name)
            if value.ndim > 1:
                must = "be one number or one for each joint"
                fail(name, must, f"it has shape {value.shape}")
        for name in ("wavenumber", "frequency"):
            shape(name, getattr(self, name), ())
        for name in ("amplitude", "wavenumber", "frequency", "phase"):
            finite(name, getattr(self, name))

    def __call__(
        self,
        t: Float[Array, ""],
        arclength: Float[Array, " joints"],
        length: Float[Array, " joints"],
    ) -> Float[Array, " joints"]:
        """Signed curvature at each joint [1/length]."""
        turns = self.wavenumber * arclength - 2 * np.pi * self.frequency * t
        return self.amplitude * jnp.sin(turns + self.phase)
