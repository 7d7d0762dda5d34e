"""What two spheres do to one another, as coefficients of tensors: Rotne-Prager-Yamakawa with rotation,
and the response to strain.

Separations are in units of a radius: in single precision the sixth power of a micrometre is not there.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from .pairs import Field, Radii


class Separation(NamedTuple):
    """Of two spheres, in units of a radius."""

    vector: list[Field]  # r_i - r_j
    distance: Field  # 0 on the diagonal
    inverse: Field  # 1 / distance, 0 where the distance is 0


@jax.custom_jvp
def _root(square: Field) -> Field:
    """A square root without a slope at 0, where two beads are in the same place."""
    return jnp.sqrt(square)


@_root.defjvp
def _root_jvp(primals: tuple[Field], tangents: tuple[Field]) -> tuple[Field, Field]:
    root = _root(*primals)
    zero = root == 0
    # XLA: a division, as in `kept_coefficients`: in reverse, all that depends on r is summed once.
    return root, jnp.where(zero, 0.0, tangents[0]) / jnp.where(zero, 1.0, 2 * root)


def _inverse(distance: Field) -> Field:
    zero, one = distance == 0, jnp.ones_like(distance)
    return jnp.where(zero, 0.0, one) / jnp.where(zero, one, distance)


def separation(vector: list[Field]) -> Separation:
    """The same with the distance."""
    distance = _root(sum(d * d for d in vector))
    return Separation(vector, distance, _inverse(distance))


class Scalars(NamedTuple):
    """Coefficients of I, dd, d x, with d = r_i - r_j (not normalised); tt over 1/(6 pi mu a), tr and rt
    over 1/(8 pi mu a^2), rr over 1/(8 pi mu a^3), a the unit of length.
    """

    tt1: Array
    tt2: Array
    tr: Array  # v_i = tr T_j x d
    rt: Array  # w_i = rt F_j x d
    rr1: Array
    rr2: Array


def factors(length: Array) -> tuple[Array, Array, Array]:
    """1/(6 pi a), 1/(8 pi a^2), 1/(8 pi a^3)."""
    one = 1 / length  # first: the derivative of 1/a^3 as a quotient holds a^-6
    return one / (6 * np.pi), one * one / (8 * np.pi), one * one * one / (8 * np.pi)


def _equal(s: Separation) -> Scalars:
    # On the diagonal the overlap branch at distance 0 is the mobility of a single sphere.
    x, ix = s.distance, s.inverse
    y = jnp.minimum(ix, 0.5)  # 1/x of separate spheres; bounded where the other branch holds
    y2, y3 = y * y, y * y * y
    near = x <= 2
    tr = jnp.where(near, 0.5 - 3 * x / 16, y3)
    return Scalars(
        tt1=jnp.where(near, 1 - 9 * x / 32, 0.75 * y + 0.5 * y3),
        tt2=jnp.where(near, 3 * ix / 32, (0.75 - 1.5 * y2) * y3),
        tr=tr,
        rt=tr,
        rr1=jnp.where(near, 1 - 27 * x / 32 + 5 * x * x * x / 64, -0.5 * y3),
        rr2=jnp.where(near, 9 * ix / 32 - 3 * x / 64, 1.5 * y2 * y3),
    )


class _Overlap(NamedTuple):
    """Spheres that overlap. By the ratio q all is regular, also where equal ones are in one place."""

    r: Array  # distance; that of contact where they do not overlap
    inverse: Array
    q: Array  # (a - b)/r, in [-1, 1]

    def rr(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Coefficients of I and of the unit dyad in rr, times 8 pi (a b)^3."""
        r, u = self.r, self.q * self.q
        one = 5 * r**2 - 27 * (a**2 + b**2) - 9 * u * (a + b) ** 2
        s = a**2 + 4 * a * b + b**2
        one = 32 * (a**3 + b**3) + r * (one - u * u * s)
        return one / 64, 3 * r * (1 - u) ** 2 * (s - r * r) / 64

    def rt(self, a: Array, b: Array, q: Array) -> Array:
        """rt times 8 pi: spin of the sphere of radius a, force on that of radius b, q = (a - b)/r."""
        return (1 + q) ** 2 * (6 * a + 2 * b - 3 * self.r - q * (3 * a + b)) / (16 * a**3 * b)


def _distances(s: Separation, a: Array, b: Array) -> tuple[Array, Array, _Overlap, Array]:
    """Whether one sphere is within the other (also the diagonal); whether they meet at all; those that
    overlap; inverse distance of those that do not, a regular value elsewhere.
    """
    inside, near, touching = s.distance <= jnp.abs(a - b), s.distance <= a + b, a + b
    r = jnp.where(near & ~inside, s.distance, touching)
    inverse = 1 / r
    overlap = _Overlap(r, inverse, (a - b) * inverse)
    return inside, near, overlap, 1 / jnp.where(near, touching, s.distance)


def _unequal(s: Separation, a: Array, b: Array) -> Scalars:
    inside, near, o, y = _distances(s, a, b)
    big, y2 = jnp.maximum(a, b), y * y
    y3, u = y2 * y, o.q * o.q
    m, q, sq = 1 / (a * b), 1 / (a * b) ** 3, a**2 + b**2
    rr1, rr2 = o.rr(a, b)

    def choose(within: Array | float, overlap: Array, apart: Array) -> Array:
        return jnp.where(inside, within, jnp.where(near, overlap, apart))

    return Scalars(
        tt1=choose(
            1 / big,
            m * (0.5 * (a + b) - o.r * (3 + u) ** 2 / 32),
            y * (0.75 + sq * y2 / 4),
        ),
        tt2=choose(0.0, m * 3 / 32 * (1 - u) ** 2 * o.inverse, 0.75 * y3 * (1 - sq * y2)),
        tr=choose(jnp.where(b > a, 1 / b**3, 0.0), o.rt(b, a, -o.q), y3),
        rt=choose(jnp.where(a > b, 1 / a**3, 0.0), o.rt(a, b, o.q), y3),
        rr1=choose(1 / big**3, q * rr1, -0.5 * y3),
        rr2=choose(0.0, q * rr2 * (o.inverse * o.inverse), 1.5 * y2 * y3),
    )


def coefficients(vector: list[Field], radii: Radii | None) -> Scalars:
    """Those of each pair, of separations and radii in units of a length (`None`: all have that one)."""
    s = separation(vector)
    return _unequal(s, *radii) if isinstance(radii, tuple) else _equal(s)


def separate(
    vector: list[Field],
    radii: Radii | None,
    there: Bool[Array, "to of"] | None = None,
    slack: Array | float = 0.0,
) -> tuple[Scalars, Bool[Array, "to of"]]:
    """The same of spheres that do not overlap, all powers of one field; and which of them do, by more
    than some slack, a part of the square of their distance. Pairs that are not `there` have
    coefficients 0.

    There rr1 is -tr/2, whatever the radii.
    """
    square = jnp.asarray(sum(d * d for d in vector))
    contact, least = 2.0, 1.0
    if isinstance(radii, tuple):
        contact = radii[0] + radii[1]
        least = lax.stop_gradient(jnp.minimum(jnp.min(radii[0]), jnp.min(radii[1])))
    touching = jnp.asarray(contact * contact, square.dtype)
    y = lax.rsqrt(jnp.maximum(square, touching))
    # XLA: never less, but the square of the root would be a division.
    y = jnp.minimum(y, 0.5 / least)
    y = y if there is None else jnp.where(there, y, 0.0)
    y2, y3 = y * y, y * y * y
    if isinstance(radii, tuple):
        both = radii[0] ** 2 + radii[1] ** 2
        tt1, tt2 = y * (0.75 + both / 4 * y2), 0.75 * y3 * (1 - both * y2)
    else:
        tt1, tt2 = 0.75 * y + 0.5 * y3, (0.75 - 1.5 * y2) * y3
    return Scalars(tt1, tt2, y3, y3, -0.5 * y3, 1.5 * y2 * y3), square < touching * (1 - slack)


def kept_coefficients(
    vector: list[Field], radii: Radii | None, length: Array, viscosity: Array
) -> Scalars:
    """The same with their dimensions, as fields that are read more than once."""
    six, cross, eight = factors(length)
    k = coefficients(vector, radii)
    # XLA: each ends in a division; on the CPU it computes what looks cheap anew wherever it is read, but
    # never a division.
    tr = cross * k.tr / viscosity
    return Scalars(
        six * k.tt1 / viscosity,
        six * k.tt2 / viscosity,
        tr,
        tr if k.rt is k.tr else cross * k.rt / viscosity,
        eight * k.rr1 / viscosity,
        eight * k.rr2 / viscosity,
    )


def _strain_equal(s: Separation) -> tuple[Array, Array, Array]:
    x, ix = s.distance, s.inverse
    y = jnp.minimum(ix, 0.5)
    y2, y3 = y * y, y * y * y
    near = x <= 2
    c1 = jnp.where(near, -0.5 + 5 * x / 24, -8 / 3 * y2 * y3)
    c2 = jnp.where(near, -5 * ix / 96, (20 / 3 * y2 - 2.5) * y2 * y3)
    cr = jnp.where(near, (5 * x * x - 30) * ix / 64, -2.5 * y2 * y3)
    return c1, c2, cr


def _strain_unequal(s: Separation, a: Array, b: Array) -> tuple[Array, Array, Array]:
    inside, near, o, y = _distances(s, a, b)
    q, u, sq, y2 = o.q, o.q * o.q, 5 * a**2 + 3 * b**2, y * y
    far, part = b**3 * (y2 * y2 * y), (1 - u) ** 2 * o.inverse
    c1_near = 10 * o.r - 24 * a + 15 * q * (a + b) - q * u * u * (a + 5 * b)
    c2_near = 5 * part * (q * o.inverse * (a + 5 * b) - 1)
    cr_near = -5 * part * (a**2 + 4 * a * b + b**2 - o.r * o.r) / (64 * a**3)
    c1 = jnp.where(near, c1_near / (48 * a), -far * sq / 3)
    c2 = jnp.where(near, c2_near / (96 * a), far * (5 * sq * y2 - 15) / 6)
    cr = jnp.where(near, cr_near, -2.5 * far)
    within = jnp.where(b > a, -1.0, 0.0)
    return (
        jnp.where(inside, within, c1),
        jnp.where(inside, 0.0, c2),
        jnp.where(inside, 0.0, cr),
    )


def strain_coefficients(s: Separation, radii: Radii | None) -> tuple[Array, Array, Array]:
    """c1, c2, cr of C, see `tensors.shear_disturbance`, in units of the length."""
    return _strain_unequal(s, *radii) if isinstance(radii, tuple) else _strain_equal(s)
