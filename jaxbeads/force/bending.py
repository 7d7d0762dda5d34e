"""Bending: an elastic moment at every inner bead, as torques or as an energy.

The moment is m_i = K_b (kappa_i - kappa_0) b at the inner beads and zero at the ends, eqs (28)-(31)
of Delmotte, Climent & Plouraboué (2015).
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail, kind, shape
from .._functions import along
from .._typing import float_array
from ..chain import Chain
from ..geometry import tangents, turning_angles
from ..setting import Setting
from ..state import Load, State
from .base import AbstractForce, AbstractPotential
from .curvature import (
    AbstractDiscreteCurvature,
    CrossProductCurvature,
    Curvature,
    check_bending,
    curvature_at_rest,
    moments,
    oriented,
    rest_at,
    stiffest,
)

_CROSS_PRODUCT = CrossProductCurvature()


def _joint_length(chain: Chain) -> Float[Array, " joints"]:
    bond = chain.bond_length
    return 0.5 * (bond[1:] + bond[:-1])


def _rest(name: str, intrinsic: Curvature, t: Float[Array, ""], chain: Chain, dim: int) -> Array:
    fibre = chain.fibre_of_bead[1:-1]
    if isinstance(intrinsic, jax.Array):  # no time, no arclength
        return intrinsic if intrinsic.ndim else jnp.broadcast_to(intrinsic, fibre.shape)
    return rest_at(name, intrinsic, t, chain.arclength[1:-1], chain.length[fibre], dim)


def _bending_step(rigidity: Array, scene: Setting) -> Float[Array, ""]:
    """mu l^4 / K_b, l = 2 (a + eps_g), eq. (39); infinite without a joint."""
    chain = scene.chain
    most = stiffest(rigidity, chain.joint_mask)
    square = (2 * jnp.min(chain.radius + chain.gap)) ** 2
    # Not l^4, which single precision may not hold.
    step = scene.viscosity * square / jnp.where(most == 0, 1.0, most) * square
    return jnp.where(most == 0, jnp.inf, step)


def _torques(moments: Float[Array, "joints spins"], chain: Chain) -> Float[Array, "beads spins"]:
    """Torques on the beads from moments at the inner beads."""
    m = jnp.pad(moments, ((1, 1), (0, 0)))
    couple = m[1:] - m[:-1]
    share = (chain.reach[:-1] / chain.bond_length)[:, None]
    first = jnp.pad(share * couple, ((0, 1), (0, 0)))
    second = jnp.pad((1 - share) * couple, ((1, 0), (0, 0)))
    return first + second


class Bending(AbstractForce):
    """Bending moments as torques on the beads.

    The couple m_{i+1} - m_i of each bond is shared by its two beads in proportion to their radii,
    because that is how a rolling bond turns; for equal radii gamma_i = (m_{i+1} - m_{i-1}) / 2. This
    is eq. (32) of the paper with the factor 1/2 that virtual work demands and the print lacks. Torques
    sum to zero. Under `Gears` the beads' velocities equal those of `BendingEnergy`.

    **Arguments**

    - `rigidity`: K_b [force length^2], one for all joints or one each, `(beads - 2,)`.
    - `intrinsic_curvature`: kappa_0 [1/length], one or one each. Signed in the plane; in space along
      the present binormal, eq. (31), hence without effect on a straight joint; or vectors
      `(beads - 2, 3)` that keep their direction in space. What turns with the material are the two
      curvatures of `ElasticRod`. For an active fibre a function kappa_0(t, arclength, length) of the
      joints, as those of `jaxbeads.actuation`.
    - `discrete_curvature`: `CrossProductCurvature()` (34) or `SineRuleCurvature()` (33).

    **Raises** `ValueError` for a negative rigidity, values that are not finite, or wrong shapes.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import Bending
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> bent = jb.State(jb.from_tangents(chain, [[1.0, 0.0], [0.8, 0.6]]))  # kappa = 0.6/2
    >>> setting = jb.Setting(chain, viscosity=1.0)
    >>> torque = Bending(rigidity=10.0).load(jnp.zeros(()), bent, setting).torque
    >>> print(torque.round(6).ravel())  # half of K_b kappa, none, minus half of it
    [ 1.5  0.  -1.5]
    """

    rotational: ClassVar[bool] = True
    smooth: ClassVar[bool] = True
    internal: ClassVar[bool] = True
    stiff: ClassVar[bool] = True
    rigidity: Array
    intrinsic_curvature: Curvature
    discrete_curvature: AbstractDiscreteCurvature

    def __init__(
        self,
        rigidity: Any,
        intrinsic_curvature: Any = 0.0,
        discrete_curvature: AbstractDiscreteCurvature = _CROSS_PRODUCT,
    ) -> None:
        self.rigidity = float_array(rigidity)
        self.intrinsic_curvature = curvature_at_rest(intrinsic_curvature)
        self.discrete_curvature = discrete_curvature

    def __check_init__(self) -> None:
        kind("discrete_curvature", self.discrete_curvature, AbstractDiscreteCurvature)
        check_bending(self.rigidity, self.intrinsic_curvature, spatial=True)

    def moments(
        self, t: Float[Array, ""], state: State, chain: Chain
    ) -> Float[Array, "joints spins"]:
        """Moment m_i at each inner bead [force length]; zero where fibres end."""
        e, dim = tangents(state.position), state.position.shape[1]
        name = f"{type(self).__name__}.intrinsic_curvature"
        rest = _rest(name, self.intrinsic_curvature, t, chain, dim)
        m = moments(
            self.rigidity,
            self.discrete_curvature,
            e[:-1],
            e[1:],
            _joint_length(chain),
            oriented(rest, e[:-1], e[1:]),
        )
        return m * chain.joint_mask[:, None]

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """Torques on the beads."""
        chain = scene.chain
        if chain.beads < 3:
            return Load()
        return Load(torque=_torques(self.moments(t, state, chain), chain))

    def energy(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, ""]:
        """Bending energy [force length], that of `BendingEnergy`. **Raises** `ValueError` for a
        curvature at rest given as vectors.
        """
        return _energy(self, t, state, scene.chain)

    def check(self, chain: Chain, dim: int) -> None:
        """Shapes that fit the joints."""
        joints, name = max(chain.beads - 2, 0), type(self).__name__
        shape(f"{name}.rigidity", self.rigidity, (), (joints,))
        dtype = chain.radius.dtype
        along(f"{name}.intrinsic_curvature", self.intrinsic_curvature, joints, dim, dtype)

    def explicit_step(self, scene: Setting) -> Float[Array, ""]:
        """The paper's step (39)."""
        return _bending_step(self.rigidity, scene)


def _energy(
    force: "Bending | BendingEnergy", t: Float[Array, ""], state: State, chain: Chain
) -> Float[Array, ""]:
    """Sum of (K_b / l)(G(phi) - l kappa_0 phi)."""
    e = tangents(state.position)
    cosine = jnp.sum(e[:-1] * e[1:], axis=-1)
    name = f"{type(force).__name__}.intrinsic_curvature"
    dim = e.shape[1] if isinstance(force, Bending) else 2
    rest = _rest(name, force.intrinsic_curvature, t, chain, dim)
    if rest.ndim > 1:
        fail(name, "be one number for each joint in an energy", f"it has shape {rest.shape}")
    rest = rest * turning_angles(state.position)
    joint = force.rigidity * (force.discrete_curvature.energy(cosine) / _joint_length(chain) - rest)
    return jnp.sum(joint * chain.joint_mask)


class DrivingMoment(AbstractForce):
    """Active moments at the inner beads, given as such: torques of -m(s, t) shared as in `Bending`.

    m = K_b kappa_0 drives as the preferred curvature kappa_0 of `Bending(K_b, kappa_0)` does; positive
    moments bend a planar fibre anticlockwise. The torques sum to zero.

    **Argument**: `moment`: as `intrinsic_curvature` of `Bending` [force length]: numbers, or a
    function of time, arclength and length.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import DrivingMoment
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> state, setting = jb.straight(chain, [1.0, 0.0]), jb.Setting(chain, viscosity=1.0)
    >>> print(DrivingMoment(2.0).load(jnp.zeros(()), state, setting).torque.ravel() + 0.0)
    [-1.  0.  1.]
    """

    rotational: ClassVar[bool] = True
    smooth: ClassVar[bool] = True
    internal: ClassVar[bool] = True
    moment: Curvature

    def __init__(self, moment: Any) -> None:
        self.moment = curvature_at_rest(moment)

    def check(self, chain: Chain, dim: int) -> None:
        """A shape that fits the joints."""
        joints, dtype = max(chain.beads - 2, 0), chain.radius.dtype
        along("DrivingMoment.moment", self.moment, joints, dim, dtype)

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """Torques on the beads."""
        chain = scene.chain
        if chain.beads < 3:
            return Load()
        e = tangents(state.position)
        m = _rest("DrivingMoment.moment", self.moment, t, chain, e.shape[1])
        m = oriented(m, e[:-1], e[1:])
        return Load(torque=_torques(-m * chain.joint_mask[:, None], chain))


class BendingEnergy(AbstractPotential):
    """Bending as an energy of the positions, sum of (K_b / l)(G(phi) - l kappa_0 phi).

    The same elasticity as `Bending`, as forces on the centres: it needs no rotation, so it also
    serves chains without spins. Arguments as there, except that `intrinsic_curvature` is a number, one
    for each joint or a function that returns these (in space it acts on the unsigned angle and leaves
    a straight joint straight).

    **Raises** `ValueError` as `Bending`, and for a curvature at rest given as vectors.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import BendingEnergy
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> bent = jb.State(jb.from_tangents(chain, [[1.0, 0.0], [0.8, 0.6]]))  # cos phi = 0.8
    >>> setting = jb.Setting(chain, viscosity=1.0)
    >>> print(f"{BendingEnergy(rigidity=10.0).energy(jnp.zeros(()), bent, setting):.6f}")
    1.000000
    """

    rotational: ClassVar[bool] = False
    smooth: ClassVar[bool] = True
    internal: ClassVar[bool] = True
    stiff: ClassVar[bool] = True
    rigidity: Array
    intrinsic_curvature: Curvature
    discrete_curvature: AbstractDiscreteCurvature

    def __init__(
        self,
        rigidity: Any,
        intrinsic_curvature: Any = 0.0,
        discrete_curvature: AbstractDiscreteCurvature = _CROSS_PRODUCT,
    ) -> None:
        self.rigidity = float_array(rigidity)
        self.intrinsic_curvature = curvature_at_rest(intrinsic_curvature)
        self.discrete_curvature = discrete_curvature

    def __check_init__(self) -> None:
        kind("discrete_curvature", self.discrete_curvature, AbstractDiscreteCurvature)
        check_bending(self.rigidity, self.intrinsic_curvature, spatial=False)

    def energy(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, ""]:
        """Bending energy [force length]."""
        return _energy(self, t, state, scene.chain)

    def check(self, chain: Chain, dim: int) -> None:
        """Shapes that fit the joints."""
        joints, name = max(chain.beads - 2, 0), type(self).__name__
        shape(f"{name}.rigidity", self.rigidity, (), (joints,))
        dtype = chain.radius.dtype
        along(f"{name}.intrinsic_curvature", self.intrinsic_curvature, joints, 2, dtype)

    def explicit_step(self, scene: Setting) -> Float[Array, ""]:
        """Half of AB3's limit, 6/11 over the fastest rate, which is at most 16 (K_b / l^3)/(6 pi mu a):
        0.16 times the paper's step (39). Forces across a fibre move single beads, as torques do not;
        with interactions between beads the limit is 2.7 times as far.
        """
        chain = scene.chain
        share = jnp.min(chain.radius) / (2 * jnp.min(chain.radius + chain.gap))
        return 3 / 11 * 6 * np.pi / 16 * share * _bending_step(self.rigidity, scene)
