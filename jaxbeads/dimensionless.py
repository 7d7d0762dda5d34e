"""Dimensionless groups, their inverses, and classical formulas."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


def cox_aspect_ratio(aspect_ratio: Any) -> Array:
    """Aspect ratio of the spheroid that rotates like a fibre of length over diameter r_p,
    r_e = 1.24 r_p / sqrt(ln r_p), eq. (52) (Cox, J. Fluid Mech. 45 (1971) 625).

    >>> from jaxbeads.dimensionless import cox_aspect_ratio
    >>> print(f"{cox_aspect_ratio(20.0):.3f}")
    14.328
    """
    return 1.24 * aspect_ratio / jnp.sqrt(jnp.log(aspect_ratio))


def larson_aspect_ratio(aspect_ratio: Any) -> Array:
    """As `cox_aspect_ratio`, r_e = 0.7 r_p, eq. (53) (Larson, 1999).

    >>> from jaxbeads.dimensionless import larson_aspect_ratio
    >>> print(larson_aspect_ratio(20.0))
    14.0
    """
    return 0.7 * jnp.asarray(aspect_ratio)


def jeffery_period(equivalent_aspect_ratio: Any, shear_rate: Any) -> Array:
    """T = 2 pi (r_e + 1/r_e) / shear rate, eq. (51) (Jeffery, Proc. R. Soc. A 102 (1922) 161).

    >>> from jaxbeads.dimensionless import cox_aspect_ratio, jeffery_period
    >>> print(f"{jeffery_period(1.0, 0.5):.3f}")  # a sphere: 4 pi over the shear rate
    25.133
    >>> print(f"{jeffery_period(cox_aspect_ratio(10.0), 1.0):.2f}")
    52.11
    """
    r = jnp.asarray(equivalent_aspect_ratio)
    return 2 * np.pi * (r + 1 / r) / shear_rate


def _bending_ratio_scale(radius: Any, aspect_ratio: Any) -> Array:
    """BR mu shear_rate / K_b."""
    r_p = jnp.asarray(aspect_ratio, float)
    slender = jnp.log(2 * cox_aspect_ratio(r_p)) - 1.5
    return 4 * slender / (np.pi * jnp.asarray(radius) ** 4 * 2 * r_p**4)


def bending_ratio(
    rigidity: Any, radius: Any, aspect_ratio: Any, viscosity: Any, shear_rate: Any
) -> Array:
    """BR = E (ln 2 r_e - 1.5) / (2 mu shear_rate r_p^4), eq. (54), with K_b = pi a^4 E / 4, r_p the
    aspect ratio L/(2a) (the number of touching beads) and r_e after Cox, eq. (52). Small values:
    flexible.

    >>> from jaxbeads.dimensionless import bending_ratio
    >>> print(f"{bending_ratio(700.0, radius=1.0, aspect_ratio=20, viscosity=1.0, shear_rate=0.5):.4f}")
    0.0103
    """
    return rigidity * _bending_ratio_scale(radius, aspect_ratio) / (viscosity * shear_rate)


def rigidity_from_bending_ratio(
    ratio: Any, radius: Any, aspect_ratio: Any, viscosity: Any, shear_rate: Any
) -> Array:
    """K_b [force length^2] of the bending ratio, the inverse of `bending_ratio`.

    >>> from jaxbeads.dimensionless import bending_ratio, rigidity_from_bending_ratio
    >>> fluid = {"radius": 1.0, "aspect_ratio": 20, "viscosity": 1.0, "shear_rate": 0.5}
    >>> print(f"{bending_ratio(rigidity_from_bending_ratio(0.04, **fluid), **fluid):.6f}")
    0.040000
    """
    return ratio * viscosity * shear_rate / _bending_ratio_scale(radius, aspect_ratio)


def elasto_gravitational_number(weight: Any, length: Any, rigidity: Any) -> Array:
    """B = F L^2 / K_b, eq. (55), with F the weight of the whole fibre. Large values: flexible.

    >>> from jaxbeads.dimensionless import elasto_gravitational_number
    >>> print(elasto_gravitational_number(weight=34.0, length=68.0, rigidity=157.216))
    1000.0
    """
    return weight * jnp.asarray(length) ** 2 / rigidity


def sperm_number(length: Any, angular_frequency: Any, friction: Any, rigidity: Any) -> Array:
    """Sp = L (zeta (gamma/L) / K_b)^(1/4), eq. (58), with gamma [force time/length] the normal friction
    coefficient of the rigid straight fibre (viscosity included) and zeta the angular frequency. Large
    values: flexible.

    >>> from jaxbeads.dimensionless import sperm_number
    >>> print(f"{sperm_number(length=2.0, angular_frequency=3.0, friction=6.0, rigidity=9.0):.6f}")
    2.000000
    """
    drag = jnp.asarray(friction) / length
    return length * (angular_frequency * drag / rigidity) ** 0.25


def rigidity_from_sperm_number(
    number: Any, length: Any, angular_frequency: Any, friction: Any
) -> Array:
    """K_b [force length^2] of Sp, the inverse of `sperm_number`.

    >>> from jaxbeads.dimensionless import rigidity_from_sperm_number
    >>> print(rigidity_from_sperm_number(2.0, length=2.0, angular_frequency=3.0, friction=6.0))
    9.0
    """
    return angular_frequency * jnp.asarray(friction) * length**3 / jnp.asarray(number) ** 4


def largest_joint_curvature(radius: Any, gap: Any) -> Array:
    """kappa_max = sqrt(1 - (a/(a + eps_g))^2) / a: curvature up to which neighbours of the Joint
    Model do not overlap, eq. (4) [1/length].

    >>> from jaxbeads.dimensionless import largest_joint_curvature
    >>> print(f"{largest_joint_curvature(radius=1.0, gap=0.25):.3f}")
    0.600
    """
    return jnp.sqrt(1 - (radius / (radius + jnp.asarray(gap))) ** 2) / radius


def rigidity_from_elasto_gravitational_number(number: Any, weight: Any, length: Any) -> Array:
    """K_b [force length^2] of B, the inverse of `elasto_gravitational_number`.

    >>> from jaxbeads.dimensionless import rigidity_from_elasto_gravitational_number
    >>> print(rigidity_from_elasto_gravitational_number(1000.0, weight=34.0, length=68.0))
    157.216
    """
    return weight * jnp.asarray(length) ** 2 / number
