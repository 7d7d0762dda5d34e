"""What a preferred curvature is."""

import abc

import equinox as eqx
from jaxtyping import Array, Float


class AbstractCurvature(eqx.Module):
    """Preferred curvature kappa_0(s, t) at the joints of a fibre, whose bending moment is then
    m = K_b (kappa - kappa_0) b: the driving torques of an active fibre. They are internal, so their sum
    and the total force vanish.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.actuation import AbstractCurvature
    >>> class Pulse(AbstractCurvature):
    ...     def __call__(self, t, arclength, length):
    ...         return jnp.sin(t) * arclength / length
    >>> print(Pulse()(jnp.array(jnp.pi / 2), jnp.array([2.0, 4.0]), jnp.array([8.0, 8.0])))
    [0.25 0.5 ]
    """

    @abc.abstractmethod
    def __call__(
        self,
        t: Float[Array, ""],
        arclength: Float[Array, " joints"],
        length: Float[Array, " joints"],
    ) -> Float[Array, " joints"] | Float[Array, "joints 3"]:
        """Curvature [1/length] at each joint: signed in the plane; in space about an axis of the
        material (two of them in `force.ElasticRod`), along the binormal or vectors (`force.Bending`).

        **Arguments**: time; arclength from the first end of the joint's fibre [length]; length of that
        fibre [length].
        """
