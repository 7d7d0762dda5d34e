"""What bending forces share: discrete curvature at a joint, and the curvature at rest."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail, finite, non_negative
from .._functions import curvature_of, leaf_function
from .._typing import float_array
from ..geometry import cross, unit

Curvature = Array | Callable[[Array, Array, Array], Array]
"""Curvature at rest: numbers, or a function of time, arclength and length (`jaxbeads.actuation`)."""


class AbstractDiscreteCurvature(eqx.Module):
    """Discrete curvature at a joint where the tangent turns by phi over the arclength l (= 2a).

    >>> import jax.numpy as jnp
    >>> from jaxbeads.force import AbstractDiscreteCurvature
    >>> class Angle(AbstractDiscreteCurvature):  # kappa = phi/l, for turns that do not vanish
    ...     def secant(self, cosine):
    ...         return jnp.arccos(cosine) / jnp.sqrt(1 - cosine**2)
    ...     def energy(self, cosine):
    ...         return jnp.arccos(cosine) ** 2 / 2
    >>> print(f"{Angle().energy(jnp.cos(0.2)):.6f}")
    0.020000
    """

    @abc.abstractmethod
    def secant(self, cosine: Array) -> Array:
        """kappa l / sin(phi), so that the curvature vector is secant (e x e') / l."""

    @abc.abstractmethod
    def energy(self, cosine: Array) -> Array:
        """Integral of kappa l over phi: the bending energy of a joint times l / K_b."""


class CrossProductCurvature(AbstractDiscreteCurvature):
    """kappa = |e x e'| / (2a), eq. (34); energy K_b (1 - cos phi) / (2a). Smooth for a straight and a
    folded chain; weakens when the chain turns by more than a right angle at one bead.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.force import CrossProductCurvature
    >>> curve, turn = CrossProductCurvature(), jnp.pi / 6
    >>> print(f"{curve.secant(jnp.cos(turn)) * jnp.sin(turn):.4f} {curve.energy(jnp.cos(turn)):.4f}")
    0.5000 0.1340
    """

    def secant(self, cosine: Array) -> Array:
        """1."""
        return jnp.ones_like(cosine)

    def energy(self, cosine: Array) -> Array:
        """1 - cos phi."""
        return 1 - cosine


class SineRuleCurvature(AbstractDiscreteCurvature):
    """kappa = sin(phi/2) / a, eq. (33): the circle through three neighbouring centres; energy
    (2 K_b / a)(1 - cos(phi/2)). Grows up to the fold, where its direction is undefined.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.force import SineRuleCurvature
    >>> curve, turn = SineRuleCurvature(), jnp.pi / 3
    >>> print(f"{curve.secant(jnp.cos(turn)) * jnp.sin(turn):.6f}")  # kappa 2a = 2 sin(phi/2)
    1.000000
    """

    def _half(self, cosine: Array) -> Array:
        square = 0.5 * (1 + cosine)
        folded = square <= 0
        return jnp.where(folded, 0.0, jnp.sqrt(jnp.where(folded, 1.0, square)))

    def secant(self, cosine: Array) -> Array:
        """1 / cos(phi/2)."""
        half = self._half(cosine)
        return 1 / jnp.where(half == 0, 1.0, half)

    def energy(self, cosine: Array) -> Array:
        """4 (1 - cos(phi/2))."""
        return 4 * (1 - self._half(cosine))


def curvature_at_rest(value: Any) -> Curvature:
    """Converter of the argument `intrinsic_curvature`."""
    return leaf_function(value) if callable(value) else float_array(value)


def check_bending(rigidity: Array, intrinsic: Curvature, spatial: bool) -> None:
    """Refuse a negative rigidity and shapes that fit no chain."""
    if rigidity.ndim > 1:
        fail("rigidity", "be one number or one for each joint", f"it has shape {rigidity.shape}")
    non_negative("rigidity", rigidity)
    if not isinstance(intrinsic, jax.Array):
        return
    vector = spatial and intrinsic.ndim == 2 and intrinsic.shape[1] == 3
    if intrinsic.ndim > 1 and not vector:
        must = "be one number or one for each joint"
        fail("intrinsic_curvature", must, f"it has shape {intrinsic.shape}")
    finite("intrinsic_curvature", intrinsic)


def rest_at(
    name: str,
    intrinsic: Curvature,
    t: Float[Array, ""],
    arclength: Float[Array, " joints"],
    length: Float[Array, " joints"],
    dim: int,
) -> Array:
    """Curvature at rest at one instant, `(joints,)`, in space also `(joints, 3)`; its name, for what
    a function has wrong.
    """
    if not isinstance(intrinsic, jax.Array):
        return curvature_of(name, intrinsic, t, arclength, length, dim)
    return intrinsic if intrinsic.ndim else jnp.broadcast_to(intrinsic, arclength.shape)


def stiffest(rigidity: Array, mask: np.ndarray) -> Array:
    """The largest rigidity (or stiffness) where `mask` has a joint (or bond); 0 if there is none."""
    each = jnp.broadcast_to(rigidity, mask.shape)
    return jnp.max(each, where=mask, initial=0.0)


def moments(
    rigidity: Array,
    discrete_curvature: AbstractDiscreteCurvature,
    before: Float[Array, "joints dim"],
    after: Float[Array, "joints dim"],
    span: Float[Array, " joints"],
    rest: Float[Array, "joints spins"],
) -> Float[Array, "joints spins"]:
    """K_b (kappa - kappa_0) at joints where a tangent turns from `before` to `after` over the arclength
    `span`.
    """
    sine, cosine = cross(before, after), jnp.sum(before * after, axis=-1)
    curvature = (discrete_curvature.secant(cosine) / span)[:, None] * sine
    return jnp.broadcast_to(rigidity, cosine.shape)[:, None] * (curvature - rest)


def oriented(
    rest: Float[Array, " joints"] | Float[Array, "joints 3"],
    before: Float[Array, "joints dim"],
    after: Float[Array, "joints dim"],
) -> Float[Array, "joints spins"]:
    """`rest` as vectors. In space one number acts along the present binormal; three are a vector."""
    if rest.ndim > 1:
        return rest
    sine = cross(before, after)
    return rest[:, None] * (unit(sine) if sine.shape[1] == 3 else jnp.ones_like(sine))
