"""What joins two rigid bodies, or a body and space: `Weld`, `Motor`, `Hinge`, `Ball`."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import quaternions
from .._checks import fail, finite, non_negative, non_zero, shape, whole
from .._functions import check_law, law_of, leaf_function
from .._typing import float_array, optional_float_array
from ..geometry import unit

Law = Float[Array, ""] | Callable[[Array], Array]


def _law(value: Any) -> Any:
    return leaf_function(value) if callable(value) else float_array(value)


def _at(name: str, law: Law, t: Array, dtype: Any) -> Array:
    """A number, or that of a law at a time."""
    return law_of(name, law, t, (), dtype) if callable(law) else law


def _check_number(name: str, law: Law, dtype: Any) -> None:
    if callable(law):
        check_law(name, law, (), dtype)
    else:
        shape(name, law, ())
        finite(name, law)


class AbstractJoint(eqx.Module):
    """Two bodies have one point in common, about which one of them turns against the other.

    `spin` is all that a new joint has to say, and `torque` if it exerts one. Bodies and their joints
    make trees: each body is the `child` of one joint at most.

    **Arguments** of all joints

    - `parent`: index of the body that it is fixed to; `None`: space.
    - `child`: index of the body that turns.
    - `point`: where it is, in the frame in which the bodies are drawn, `(3,)` [length].

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> class Slowing(jb.body.AbstractJoint):  # a motor of a law of its own
    ...     def spin(self, t, turn, free):
    ...         return jnp.array([0.0, 0.0, 1.0]) / (1 + t)
    >>> print(Slowing(None, 0).freedoms, Slowing(None, 0).spin(1.0, None, None))
    0 [0.  0.  0.5]
    """

    freedoms: ClassVar[int] = 0
    """How many numbers its relative spin has that are not prescribed."""
    parent: int | None = eqx.field(static=True)
    child: int = eqx.field(static=True)
    point: Float[Array, "3"] = eqx.field(converter=float_array, default=(0.0, 0.0, 0.0))

    def __check_init__(self) -> None:
        for name, body in {"parent": self.parent, "child": self.child}.items():
            if name == "child" or body is not None:
                whole(name, body, 0)
        if self.parent == self.child:
            fail("child", "be another body than `parent`", f"both are {self.child}")
        shape("point", self.point, (3,))
        finite("point", self.point)

    @abc.abstractmethod
    def spin(
        self, t: Float[Array, ""], turn: Float[Array, "4"], free: Float[Array, " freedoms"]
    ) -> Float[Array, "3"]:
        """Spin of the child against the parent [1/time], in the parent's frame; affine in what is free.

        **Arguments**: time; rotation of the child against the parent since they were drawn, a
        quaternion; numbers that are not prescribed [1/time].
        """

    def torque(self, t: Float[Array, ""], turn: Float[Array, "4"]) -> Float[Array, "3"]:
        """Torque on the child [force length], in the parent's frame, beside what keeps the law of its
        spin; the parent feels the opposite one.
        """
        return jnp.zeros(3, turn.dtype)


class Weld(AbstractJoint):
    """Two bodies as one. A body that is welded to space (`parent` `None`) is held.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> held = jb.Assembly([jb.body.sphere(1.0)], 1.0, joints=[jb.body.Weld(None, 0)])
    >>> print(jb.locomotion.motion(0.0, held.drawn, held).velocity)
    [[0. 0. 0.]]
    """

    def spin(self, t: Array, turn: Array, free: Array) -> Array:
        """None."""
        return jnp.zeros(3, turn.dtype)


class _Axle(AbstractJoint):
    axis: Float[Array, "3"] = eqx.field(converter=float_array, default=(1.0, 0.0, 0.0))

    def __check_init__(self) -> None:
        shape("axis", self.axis, (3,))
        finite("axis", self.axis)
        non_zero("axis", self.axis)


class Motor(_Axle):
    """A motor: the child spins against the parent about an axis, as fast as it is told.

    **Arguments**: as `AbstractJoint`; `axis`, direction fixed to both, `(3,)`; `rate` [1/time], a number
    or a function of the time. **Raises** `ValueError` for an axis that is zero.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> balls = [jb.body.sphere(1.0), jb.body.sphere(1.0, centre=[1e4, 0.0, 0.0])]
    >>> pair = jb.Assembly(balls, 1.0, joints=[jb.body.Motor(0, 1, axis=[1.0, 0.0, 0.0], rate=2.0)])
    >>> moved = jb.locomotion.motion(0.0, pair.drawn, pair)
    >>> print(moved.spin[:, 0].round(6), (moved.joint_torque[0] / (8 * jnp.pi)).round(6))
    [-1.  1.] [1. 0. 0.]
    """

    rate: Law = eqx.field(converter=_law, default=1.0)

    def __check_init__(self) -> None:
        _check_number("Motor.rate", self.rate, self.point.dtype)

    def spin(self, t: Array, turn: Array, free: Array) -> Array:
        """As fast as it is told."""
        return unit(self.axis) * _at("Motor.rate", self.rate, t, turn.dtype)


class Hinge(_Axle):
    """An axle: the child may turn against the parent about an axis, by a torque or none.

    **Arguments**: as `AbstractJoint`; `axis`, direction fixed to both, `(3,)`; `drive`: torque on the
    child about the axis [force length], a number or a function of the time; the parent feels the
    opposite one.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> balls = [jb.body.sphere(1.0), jb.body.sphere(1.0, centre=[1e4, 0.0, 0.0])]
    >>> axle = jb.body.Hinge(0, 1, axis=[1.0, 0.0, 0.0], drive=8 * jnp.pi)
    >>> pair = jb.Assembly(balls, 1.0, joints=[axle])
    >>> print(jb.locomotion.motion(0.0, pair.drawn, pair).spin[:, 0].round(6))
    [-1.  1.]
    """

    freedoms: ClassVar[int] = 1
    drive: Law = eqx.field(converter=_law, default=0.0)

    def __check_init__(self) -> None:
        _check_number("Hinge.drive", self.drive, self.point.dtype)

    def spin(self, t: Array, turn: Array, free: Array) -> Array:
        """About the axis."""
        return unit(self.axis) * free

    def torque(self, t: Array, turn: Array) -> Array:
        """The drive's."""
        return unit(self.axis) * _at("Hinge.drive", self.drive, t, turn.dtype)


class Ball(AbstractJoint):
    """A ball and its socket: the child may turn against the parent in any way. With a stiffness it is a
    hook, whose energy is

        E = [stiffness |r|^2 + (twist_stiffness - stiffness) (r . axis)^2]/2,

    with r the axis times the angle of the turn since the bodies were drawn.

    **Arguments**: as `AbstractJoint`; `stiffness` [force length], 0 unless said; `twist_stiffness`, of
    turns about the axis, the same unless said; `axis`, `(3,)`. **Raises** `ValueError` for a stiffness
    that is negative, and an axis that is zero.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> hook = jb.body.Ball(0, 1, stiffness=2.0)
    >>> turn = jb.quaternions.about([0.0, 0.0, 1.0], 0.5)
    >>> print(hook.torque(jnp.zeros(()), turn)[2].round(12))
    -1.0
    """

    freedoms: ClassVar[int] = 3
    stiffness: Float[Array, ""] = eqx.field(converter=float_array, default=0.0)
    twist_stiffness: Float[Array, ""] | None = eqx.field(
        converter=optional_float_array, default=None
    )
    axis: Float[Array, "3"] = eqx.field(converter=float_array, default=(1.0, 0.0, 0.0))

    def __check_init__(self) -> None:
        shape("stiffness", self.stiffness, ())
        non_negative("stiffness", self.stiffness)
        if self.twist_stiffness is not None:
            shape("twist_stiffness", self.twist_stiffness, ())
            non_negative("twist_stiffness", self.twist_stiffness)
        shape("axis", self.axis, (3,))
        finite("axis", self.axis)
        non_zero("axis", self.axis)

    def spin(self, t: Array, turn: Array, free: Array) -> Array:
        """Any."""
        return free

    def torque(self, t: Array, turn: Array) -> Array:
        """The hook's, -dE/dturn."""
        if self.twist_stiffness is None:
            return -self.stiffness * quaternions.angles(turn)

        def angles(spin: Array) -> Array:
            return quaternions.angles(turn + quaternions.rate(turn, spin))

        turned, pull = jax.vjp(angles, jnp.zeros(3, turn.dtype))
        axis = unit(self.axis)
        twist = (self.twist_stiffness - self.stiffness) * (turned @ axis) * axis
        return -pull(self.stiffness * turned + twist)[0]
