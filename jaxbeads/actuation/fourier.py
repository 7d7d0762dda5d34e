"""Preferred curvature as a Fourier series in arclength and time."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import finite, shape
from .._typing import float_array
from .base import AbstractCurvature


class FourierCurvature(AbstractCurvature):
    """kappa_0(s, t) = sum over m, n of cos(m pi s / L) (A_mn cos(2 pi n f t) + B_mn sin(2 pi n f t)).

    Any periodic drive, with m = 0 ... modes - 1 along the fibre and n = 0 ... harmonics - 1 in time.

    **Arguments**

    - `cosine`: A [1/length], shape `(modes, harmonics)`.
    - `sine`: B [1/length], same shape (its first column has no effect).
    - `frequency`: f [1/time].

    **Raises** `ValueError` for other shapes and numbers that are not finite.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.actuation import FourierCurvature
    >>> drive = FourierCurvature(cosine=[[0.1, 0.0]], sine=[[0.0, 0.2]], frequency=1.0)
    >>> print(drive(jnp.array(0.25), jnp.array([2.0, 4.0]), jnp.array([8.0, 8.0])))  # 0.1 + 0.2
    [0.3 0.3]
    """

    cosine: Float[Array, "modes harmonics"] = eqx.field(converter=float_array)
    sine: Float[Array, "modes harmonics"] = eqx.field(converter=float_array)
    frequency: Float[Array, ""] = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        if self.cosine.ndim != 2:
            raise ValueError(
                "Argument `cosine` must have shape (modes, harmonics), but it has shape "
                f"{self.cosine.shape}."
            )
        shape("sine", self.sine, self.cosine.shape)
        shape("frequency", self.frequency, ())
        for name in ("cosine", "sine", "frequency"):
            finite(name, getattr(self, name))

    def __call__(
        self,
        t: Float[Array, ""],
        arclength: Float[Array, " joints"],
        length: Float[Array, " joints"],
    ) -> Float[Array, " joints"]:
        """Signed curvature at each joint [1/length]."""
        modes, harmonics = self.cosine.shape
        along = jnp.cos(np.pi * (arclength / length)[:, None] * np.arange(modes)[None, :])
        turns = 2 * np.pi * self.frequency * t * np.arange(harmonics)
        return along @ (self.cosine @ jnp.cos(turns) + self.sine @ jnp.sin(turns))
