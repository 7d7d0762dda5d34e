"""Preferred curvature of a cilium that beats in two strokes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail, finite, known, positive, shape
from .._typing import float_array
from .base import AbstractCurvature


class TwoStrokes(AbstractCurvature):
    """kappa_0 = d psi/ds: a straight swing there, and a way back by a bend that travels to the tip.

    psi(s, t) is the angle of the preferred shape from its first bond, anticlockwise positive,

        psi = -Theta (1 - exp(-(s/(b L))^2)) tanh(g (cos(theta - h) - cos h)/sin h),
        h(s) = pi/2 + pi d (s/L - 1/2),   theta = 2 pi f t + phi,   g = 3/(2 pi e).

    At theta = 0 all of it swings from Theta to -Theta at once, over the share e of the period: the
    effective stroke. A point at s swings back at theta = 2 h(s), the tip by the share d of the period
    after the base: the recovery. All bending of the effective stroke is in a hinge of length b L or so.

    **Arguments**

    - `swing`: Theta [rad]; positive: the effective stroke is clockwise.
    - `frequency`: f [1/time].
    - `phase`: phi [rad], one for all joints or one each.
    - `delay`: d, below 1.
    - `effective`: e.
    - `hinge`: b.

    **Raises** `ValueError` for other shapes and numbers that cannot be.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.actuation import TwoStrokes
    >>> beat = TwoStrokes(swing=1.0, frequency=1.0)
    >>> print(beat(jnp.array(0.5), jnp.array([2.0, 6.0]), jnp.array([8.0, 8.0])).round(3))
    [ 0.303 -0.081]
    """

    swing: Float[Array, ""] = eqx.field(converter=float_array)
    frequency: Float[Array, ""] = eqx.field(converter=float_array)
    phase: Array = eqx.field(converter=float_array, default=0.0)
    delay: Float[Array, ""] = eqx.field(converter=float_array, default=0.5)
    effective: Float[Array, ""] = eqx.field(converter=float_array, default=0.2)
    hinge: Float[Array, ""] = eqx.field(converter=float_array, default=0.25)

    def __check_init__(self) -> None:
        if self.phase.ndim > 1:
            must = "be one number or one for each joint"
            fail("phase", must, f"it has shape {self.phase.shape}")
        for name in ("swing", "frequency", "delay", "effective", "hinge"):
            shape(name, getattr(self, name), ())
        for name in ("swing", "frequency", "phase", "delay"):
            finite(name, getattr(self, name))
        for name in ("effective", "hinge"):
            positive(name, getattr(self, name))
        if known(self.delay) and not abs(self.delay) < 1:
            fail("delay", "be less than the period, 1", f"it is {self.delay:g}")

    def angle(
        self, t: Float[Array, ""], arclength: Float[Array, " n"], length: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """psi(s, t) [rad]."""
        part = arclength / length
        half = np.pi / 2 + np.pi * self.delay * (part - 0.5)
        theta = 2 * np.pi * self.frequency * t + self.phase
        ahead = (jnp.cos(theta - half) - jnp.cos(half)) / jnp.sin(half)
        bent = 1 - jnp.exp(-((part / self.hinge) ** 2))
        return -self.swing * bent * jnp.tanh(1.5 / (np.pi * self.effective) * ahead)

    def __call__(
        self,
        t: Float[Array, ""],
        arclength: Float[Array, " joints"],
        length: Float[Array, " joints"],
    ) -> Float[Array, " joints"]:
        """Signed curvature at each joint [1/length]."""
        one = jnp.ones_like(arclength)
        return jax.jvp(lambda s: self.angle(t, s, length), (arclength,), (one,))[1]
