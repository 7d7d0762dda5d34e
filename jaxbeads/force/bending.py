"""Bending: an elastic moment at every inner bead, as torques or as an energy.

The moment is m_i = K_b (kappa_i - kappa_eq) b at the inner beads and zero at the ends, eqs (28)-(31)
of Delmotte, Climent & Plouraboué (2015).
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import fail, finite, kind, non_negative
from .._typing import float_array
from ..chain import Chain
from ..geometry import cross, tangents, turning_angles, unit
from ..state import Load, State
from .base import AbstractForce, AbstractPotential


class AbstractCurvatureLaw(eqx.Module):
    """Discrete curvature at a joint where the tangent turns by phi over the arclength l (= 2a)."""

    @abc.abstractmethod
    def secant(self, cosine: Array) -> Array:
        """kappa l / sin(phi), so that the curvature vector is secant (e x e') / l."""

    @abc.abstractmethod
    def energy(self, cosine: Array) -> Array:
        """Integral of kappa l over phi: the bending energy of a joint times l / K_b."""


class CrossProductCurvature(AbstractCurvatureLaw):
    """kappa = |e x e'| / (2a), eq. (34); energy K_b (1 - cos phi) / (2a). Smooth for a straight and a
    folded chain; weakens when the chain turns by more than a right angle at one bead."""

    def secant(self, cosine: Array) -> Array:
        """1."""
        return jnp.ones_like(cosine)

    def energy(self, cosine: Array) -> Array:
        """1 - cos phi."""
        return 1 - cosine


class SineRuleCurvature(AbstractCurvatureLaw):
    """kappa = sin(phi/2) / a, eq. (33): the circle through three neighbouring centres; energy
    (2 K_b / a)(1 - cos(phi/2)). Grows up to the fold, where its direction is undefined."""

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


_DEFAULT_LAW = CrossProductCurvature()


def _joint_length(chain: Chain) -> Float[Array, " joints"]:
    bond = chain.bond_length
    return 0.5 * (bond[1:] + bond[:-1])


def _check(rigidity: Array, intrinsic: Array, spatial: bool) -> None:
    if rigidity.ndim > 1:
        fail("rigidity", "be one number or one for each joint", f"it has shape {rigidity.shape}")
    non_negative("rigidity", rigidity)
    vector = spatial and intrinsic.ndim == 2 and intrinsic.shape[1] == 3
    if intrinsic.ndim > 1 and not vector:
        must = "be one number or one for each joint"
        fail("intrinsic_curvature", must, f"it has shape {intrinsic.shape}")
    finite("intrinsic_curvature", intrinsic)


class Bending(AbstractForce):
    """Bending moments as torques on the beads.

    The couple m_{i+1} - m_i of each bond is shared by its two beads in proportion to their radii,
    because that is how a rolling bond turns; for equal radii gamma_i = (m_{i+1} - m_{i-1}) / 2. This
    is eq. (32) of the paper with the factor 1/2 that virtual work demands and the print lacks. Torques
    sum to zero. Under `Gears` the beads' velocities equal those of `BendingEnergy`.

    **Arguments**

    - `rigidity`: K_b [force length^2], one for all joints or one each, `(beads - 2,)`.
    - `intrinsic_curvature`: kappa_eq [1/length], one or one each. Signed in the plane; in space along
      the present binormal, eq. (31), hence without effect on a straight joint; or vectors
      `(beads - 2, 3)` that keep their direction in space.
    - `law`: discrete curvature, `CrossProductCurvature()` (34) or `SineRuleCurvature()` (33).

    **Raises** `ValueError` for a negative rigidity, values that are not finite, or wrong shapes.
    """

    rotational: ClassVar[bool] = True
    rigidity: Array
    intrinsic_curvature: Array
    law: AbstractCurvatureLaw

    def __init__(
        self,
        rigidity: Any,
        intrinsic_curvature: Any = 0.0,
        law: AbstractCurvatureLaw = _DEFAULT_LAW,
    ) -> None:
        self.rigidity = float_array(rigidity)
        self.intrinsic_curvature = float_array(intrinsic_curvature)
        self.law = law

    def __check_init__(self) -> None:
        kind("law", self.law, AbstractCurvatureLaw)
        _check(self.rigidity, self.intrinsic_curvature, spatial=True)

    def moments(self, state: State, chain: Chain) -> Float[Array, "joints spins"]:
        """Moment m_i at each inner bead [force length]; zero where fibres end."""
        e = tangents(state.position)
        sine, cosine = cross(e[:-1], e[1:]), jnp.sum(e[:-1] * e[1:], axis=-1)
        curvature = (self.law.secant(cosine) / _joint_length(chain))[:, None] * sine
        rest = self.intrinsic_curvature
        if rest.ndim < 2:
            binormal = unit(sine) if sine.shape[1] == 3 else jnp.ones_like(sine)
            rest = jnp.broadcast_to(rest, cosine.shape)[:, None] * binormal
        rigidity = jnp.broadcast_to(self.rigidity, cosine.shape)[:, None]
        return rigidity * (curvature - rest) * chain.joint_mask[:, None]

    def load(self, t: Float[Array, ""], state: State, chain: Chain) -> Load:
        """Torques on the beads."""
        if chain.beads < 3:
            return Load()
        m = jnp.pad(self.moments(state, chain), ((1, 1), (0, 0)))
        couple = m[1:] - m[:-1]
        share = (chain.radii[:-1] / chain.bond_length)[:, None]
        first = jnp.pad(share * couple, ((0, 1), (0, 0)))
        second = jnp.pad((1 - share) * couple, ((1, 0), (0, 0)))
        return Load(torque=first + second)


class BendingEnergy(AbstractPotential):
    """Bending as an energy of the positions, sum of (K_b / l)(law(phi) - l kappa_eq phi).

    The same elasticity as `Bending`, as forces on the centres: it needs no rotation, so it also
    serves chains without spins. Arguments as there, except that `intrinsic_curvature` is a number or
    one for each joint (in space it acts on the unsigned angle and leaves a straight joint straight).
    """

    rotational: ClassVar[bool] = False
    rigidity: Array
    intrinsic_curvature: Array
    law: AbstractCurvatureLaw

    def __init__(
        self,
        rigidity: Any,
        intrinsic_curvature: Any = 0.0,
        law: AbstractCurvatureLaw = _DEFAULT_LAW,
    ) -> None:
        self.rigidity = float_array(rigidity)
        self.intrinsic_curvature = float_array(intrinsic_curvature)
        self.law = law

    def __check_init__(self) -> None:
        kind("law", self.law, AbstractCurvatureLaw)
        _check(self.rigidity, self.intrinsic_curvature, spatial=False)

    def energy(self, t: Float[Array, ""], state: State, chain: Chain) -> Float[Array, ""]:
        """Bending energy [force length]."""
        e = tangents(state.position)
        cosine = jnp.sum(e[:-1] * e[1:], axis=-1)
        rest = self.intrinsic_curvature * turning_angles(state.position)
        joint = self.rigidity * (self.law.energy(cosine) / _joint_length(chain) - rest)
        return jnp.sum(joint * chain.joint_mask)
