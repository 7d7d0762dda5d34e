"""Magnetic fields, and what magnetic moments feel in them and of one another.

Beads are uniformly magnetised spheres with moments m in a field B(t, x) that someone applies:

    E = -sum_i m_i . B(t, r_i) - (mu_0/4 pi) sum_(i<j) m_i . G(r_i - r_j) m_j.

On a moment that is fixed to a bead act the torque m x b, with b the field and that of all other
moments, and the force of -dE/dr. Any units in which m B is an energy will do: mu_0 is a number of the
scene. Beads and fluid do not change the field.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import fail, finite, known, non_negative, shape
from ._functions import check_law, law_of, leaf_function, trial, value_of
from ._typing import float_array, optional_float_array
from .domain import AbstractDomain, Unbounded
from .geometry import cross
from .pairs import pair_sums, separations
from .state import Load

__all__ = [
    "AbstractMagneticField",
    "HarmonicField",
    "MagneticField",
    "UniformField",
    "body_load",
    "dipole_energy",
    "magnetic_energy",
    "moment_load",
]


class AbstractMagneticField(eqx.Module):
    """B(t, x), a function of the time and one point, `(dim,)` [field]. Its gradient follows by
    differentiation.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.magnetism import AbstractMagneticField
    >>> class Quadrupole(AbstractMagneticField):
    ...     def __call__(self, t, x):
    ...         return jnp.stack([x[0], -x[1]])
    >>> print(Quadrupole().at(jnp.zeros(()), jnp.array([[1.0, 2.0], [0.0, 3.0]])))
    [[ 1. -2.]
     [ 0. -3.]]
    """

    uniform: ClassVar[bool] = False
    """Whether it is the same everywhere: it then exerts no force."""

    @abc.abstractmethod
    def __call__(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The field at a point."""

    def at(
        self, t: Float[Array, ""], position: Float[Array, "some dim"]
    ) -> Float[Array, "some dim"]:
        """The field at several points."""
        if self.uniform:
            return (
                jnp.broadcast_to(self(t, position[0]), position.shape)
                if len(position)
                else position
            )
        return jax.vmap(lambda x: self(t, x))(position)

    def check(self, dim: int, dtype: Any) -> None:
        """Refuse a dimension that the field cannot serve, in one sentence."""


def _law(value: Any) -> Any:
    return leaf_function(value, "law") if callable(value) else float_array(value)


class UniformField(AbstractMagneticField):
    """B(t), the same everywhere.

    **Argument**: `law`: a vector `(dim,)` [field], or a function of the time that returns it.

    **Raises** `ValueError` for a vector that is not finite or of another shape.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.magnetism import UniformField
    >>> print(UniformField([0.0, 2.0])(jnp.zeros(()), jnp.zeros(2)))
    [0. 2.]
    """

    uniform: ClassVar[bool] = True
    law: Array | Callable[[Array], Array] = eqx.field(converter=_law)

    def __check_init__(self) -> None:
        if isinstance(self.law, jax.Array):
            shape("law", self.law, (2,), (3,))
            finite("law", self.law)

    def check(self, dim: int, dtype: Any) -> None:
        """A field of the scene's dimension."""
        if isinstance(self.law, jax.Array):
            shape("UniformField.law", self.law, (dim,))
        else:
            check_law("UniformField.law", self.law, (dim,), dtype)

    def __call__(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The vector."""
        if isinstance(self.law, jax.Array):
            return self.law
        return law_of("UniformField.law", self.law, t, x.shape, x.dtype)


class HarmonicField(AbstractMagneticField):
    """B = B_0 + B_c cos(omega t) + B_s sin(omega t), the same everywhere. It oscillates along B_c; with
    B_s as long and across, it rotates from B_c to B_s; with B_0 across both, it precesses on a cone.

    **Arguments**: `angular_frequency` omega [1/time]; `cosine` B_c, `sine` B_s and `constant` B_0,
    vectors `(dim,)` [field], of which the last two may be absent.

    **Raises** `ValueError` for numbers that are not finite or of another shape.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.magnetism import HarmonicField
    >>> rotating = HarmonicField(jnp.pi, [2.0, 0.0], [0.0, 2.0])
    >>> oscillating = HarmonicField(jnp.pi, [0.0, 2.0], constant=[5.0, 0.0])
    >>> half, here = jnp.array(0.5), jnp.zeros(2)
    >>> print(rotating(half, here).round(12), oscillating(2 * half, here))
    [0. 2.] [ 5. -2.]
    """

    uniform: ClassVar[bool] = True
    angular_frequency: Float[Array, ""] = eqx.field(converter=float_array)
    cosine: Float[Array, " dim"] = eqx.field(converter=float_array)
    sine: Float[Array, " dim"] | None = eqx.field(converter=optional_float_array, default=None)
    constant: Float[Array, " dim"] | None = eqx.field(converter=optional_float_array, default=None)

    def __check_init__(self) -> None:
        shape("angular_frequency", self.angular_frequency, ())
        finite("angular_frequency", self.angular_frequency)
        shape("cosine", self.cosine, (2,), (3,))
        for name in ("cosine", "sine", "constant"):
            if (value := getattr(self, name)) is not None:
                shape(name, value, self.cosine.shape)
                finite(name, value)

    def check(self, dim: int, dtype: Any) -> None:
        """A field of the scene's dimension."""
        shape("HarmonicField.cosine", self.cosine, (dim,))

    def __call__(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The vector."""
        phase = self.angular_frequency * t
        field = self.cosine * jnp.cos(phase)
        if self.sine is not None:
            field = field + self.sine * jnp.sin(phase)
        return field if self.constant is None else field + self.constant


class MagneticField(AbstractMagneticField):
    """B = f(t, x) from a user's function of the time and one point, `(dim,)`. A function that is a
    pytree (an `equinox.Module`) keeps its parameters as leaves; what a plain function closes over is
    constant.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.magnetism import MagneticField
    >>> gradient = MagneticField(lambda t, x: 3.0 * jnp.stack([x[0], -x[1]]))
    >>> print(gradient(jnp.zeros(()), jnp.array([1.0, 2.0])))
    [ 3. -6.]
    """

    function: Callable[[Array, Array], Array] = eqx.field(converter=leaf_function)

    def check(self, dim: int, dtype: Any) -> None:
        """A field of the scene's dimension, with a gradient."""
        t, x = jnp.zeros((), dtype), jnp.zeros(dim, dtype)
        trial(jax.jacfwd(self.__call__, argnums=1), t, x)

    def __call__(self, t: Float[Array, ""], x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The function's value."""
        name, given = "MagneticField.function", "a time and a point"
        arguments = jnp.asarray(t, x.dtype), x
        return value_of(name, given, self.function, *arguments, shapes=(x.shape,), dtype=x.dtype)


def magnetic_field(value: Any) -> AbstractMagneticField:
    """Converter of the argument `field`: a field, a vector, or a function of the time and a point."""
    if isinstance(value, AbstractMagneticField):
        return value
    return MagneticField(value) if callable(value) else UniformField(value)


def optional_magnetic_field(value: Any) -> AbstractMagneticField | None:
    """As `magnetic_field`, but `None` stays `None`."""
    return None if value is None else magnetic_field(value)


def check_magnets(
    bodies: int,
    moment: Array | None,
    susceptibility: Array | None,
    field: AbstractMagneticField | None,
) -> None:
    """Moments and susceptibilities of rigid bodies in space, and the field that they need."""
    magnets = {"moment": (bodies, 3), "susceptibility": (bodies, 3, 3)}
    there = {"moment": moment, "susceptibility": susceptibility}
    if (field is None) != (moment is None and susceptibility is None):
        given = "it is not" if field is None else "nothing is magnetic"
        fail("field", "be given with `moment` or `susceptibility`, or none of them", given)
    for name, value in there.items():
        if value is not None:
            shape(name, value, magnets[name])
            finite(name, value)
            if field is not None:
                field.check(3, value.dtype)
    if susceptibility is not None and known(susceptibility):
        chi = np.asarray(susceptibility)
        off = np.abs(chi - chi.swapaxes(1, 2)).max()
        if off > 1e-6 * np.abs(chi).max():
            fail("susceptibility", "be symmetric", f"it is off by {off:.3g}")


def check_numbers(name: str, value: Array, *allowed: tuple[int, ...]) -> None:
    """Moments or susceptibilities: finite numbers, one for all or one each."""
    if value.ndim > 1:
        fail(name, "be one number or one each", f"it has shape {value.shape}")
    finite(name, value)


def check_permeability(value: Array | None) -> None:
    """mu_0, where there is one."""
    if value is not None:
        shape("permeability", value, ())
        non_negative("permeability", value)


def dipole_energy(
    position: Float[Array, "beads dim"],
    moment: Float[Array, "beads dim"],
    radii: Float[Array, " beads"],
    permeability: Float[Array, ""] | float,
    domain: AbstractDomain | None = None,
) -> Float[Array, ""]:
    """Energy of all pairs of moments [force length],

        (mu_0/4 pi) sum over i < j of [m_i . m_j - 3 (m_i . e)(m_j . e)]/r^3,

    of spheres that do not overlap; of spheres of radius a that do, x = r/a < 2, it is that of their
    magnetic poles, -(mu_0/4 pi) m_i . grad grad psi m_j with
    psi = (6/5 - x^2/2 + 3 x^3/16 - x^5/160)/a in place of 1/r: finite, with a continuous force. (Unequal
    radii: a is their mean.)

    **Arguments**: centres [length]; moments; radii [length]; mu_0 [force (length^2/moment)^2]; the
    space, unbounded by default. Memory grows like the number of beads.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.magnetism import dipole_energy
    >>> place, along = jnp.array([[0.0, 0.0], [4.0, 0.0]]), jnp.array([[1.0, 0.0], [1.0, 0.0]])
    >>> energy = dipole_energy(place, along, jnp.ones(2), permeability=4 * jnp.pi)
    >>> print(energy)  # -2/4^3
    -0.03125
    """
    domain = Unbounded() if domain is None else domain

    def fields(to: tuple[Array, ...], of: tuple[Array, ...]) -> list[Array]:
        a = 0.5 * (to[2][:, None] + of[2][None, :])
        d = [x / a for x in domain.nearest(separations(to[0], of[0]), 1.0)]
        square = sum(x * x for x in d)
        own, here = to[3][:, None] == of[3][None, :], square == 0
        x = jnp.sqrt(jnp.where(here, 1.0, square))
        # Touching beads are at x = 2: each branch is differentiated where it holds.
        apart = x > 2
        near, far = jnp.where(apart, 1.0, x), jnp.where(apart, x, 2.0)
        isotropic = jnp.where(apart, -1 / far**3, -1 + 9 / 16 * near - near**3 / 32)
        along = jnp.where(apart, 3 / far**5, 9 / 16 / near - 3 / 32 * near)
        isotropic, along = jnp.where(here, -1.0, isotropic), jnp.where(here, 0.0, along)
        first = sum(m[:, None] * y for m, y in zip(to[1].T, d, strict=True))
        second = sum(m[None, :] * y for m, y in zip(of[1].T, d, strict=True))
        pair = isotropic * (to[1] @ of[1].T) + along * first * second
        return [jnp.where(own, 0.0, pair / a**3)]

    beads = position, moment, radii, jnp.arange(len(position))
    return -permeability / (8 * np.pi) * jnp.sum(pair_sums(fields, beads)[0])


def magnetic_energy(
    t: Float[Array, ""],
    position: Float[Array, "beads dim"],
    moment: Float[Array, "beads dim"],
    field: AbstractMagneticField,
    permeability: Float[Array, ""] | None,
    radii: Float[Array, " beads"],
    domain: AbstractDomain | None = None,
) -> Float[Array, ""]:
    """Energy of moments in a field and, where there is a `permeability`, of one another [force length].

    >>> import jax.numpy as jnp
    >>> from jaxbeads.magnetism import UniformField, magnetic_energy
    >>> place, moment = jnp.zeros((1, 2)), jnp.array([[3.0, 0.0]])
    >>> print(magnetic_energy(jnp.zeros(()), place, moment, UniformField([2.0, 5.0]), None, jnp.ones(1)))
    -6.0
    """
    energy = -jnp.sum(moment * field.at(t, position))
    if permeability is None:
        return energy
    return energy + dipole_energy(position, moment, radii, permeability, domain)


def moment_load(
    t: Float[Array, ""],
    position: Float[Array, "beads dim"],
    moment: Float[Array, "beads dim"],
    field: AbstractMagneticField,
    permeability: Float[Array, ""] | None,
    radii: Float[Array, " beads"],
    domain: AbstractDomain | None = None,
) -> Load:
    """Forces and torques on moments that are fixed to their beads, from `magnetic_energy`.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.magnetism import UniformField, moment_load
    >>> place, moment = jnp.zeros((1, 2)), jnp.array([[3.0, 0.0]])
    >>> load = moment_load(jnp.zeros(()), place, moment, UniformField([2.0, 5.0]), None, jnp.ones(1))
    >>> print(load.torque, load.force)  # m x B
    [[15.]] None
    """

    def energy(position: Array, moment: Array) -> Array:
        return magnetic_energy(t, position, moment, field, permeability, radii, domain)

    if field.uniform and permeability is None:
        return Load(torque=cross(moment, field.at(t, position)))
    force, along = jax.grad(energy, argnums=(0, 1))(position, moment)
    return Load(force=-force, torque=cross(moment, -along))


def body_load(
    t: Float[Array, ""],
    place: Float[Array, "bodies 3"],
    rotation: Float[Array, "bodies 3 3"],
    moment: Float[Array, "bodies 3"] | None,
    susceptibility: Float[Array, "bodies 3 3"] | None,
    field: AbstractMagneticField | None,
) -> Load:
    """Forces and torques on rigid bodies at places, turned by rotations R, with the energy

        E = -sum of (R m) . B + B . (R chi R^T) B/2,

    those of moments m' = R m + R chi R^T B: torques m' x B, forces grad (m' . B) with m' held.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.magnetism import UniformField, body_load
    >>> place, still, chi = jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.diag(jnp.array([2.0, 0.0, 0.0]))
    >>> field = UniformField([3.0, 1.0, 0.0])
    >>> print(body_load(jnp.zeros(()), place, still, None, chi[None], field).torque)  # chi B_x B_y
    [[0. 0. 6.]]
    """
    if field is None:
        return Load()
    total = jnp.zeros_like(place)
    if moment is not None:
        total = jnp.einsum("bij,bj->bi", rotation, moment)
    if susceptibility is not None:
        chi = jnp.einsum("bij,bjk,blk->bil", rotation, susceptibility, rotation)
        total = total + jnp.einsum("bij,bj->bi", chi, field.at(t, place))
    return moment_load(t, place, total, field, None, jnp.ones_like(place[:, 0]))
