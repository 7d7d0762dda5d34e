"""Bending of the Joint Model: moments at the joints between beads, with the repulsion it needs."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail, kind, non_negative, positive, shape
from .._functions import along
from .._typing import float_array
from ..chain import Chain
from ..geometry import bonds, norm, unit
from ..setting import Setting
from ..state import Load, State
from .base import AbstractForce, repulsion
from .curvature import (
    AbstractDiscreteCurvature,
    Curvature,
    SineRuleCurvature,
    check_bending,
    curvature_at_rest,
    moments,
    oriented,
    rest_at,
    stiffest,
)

_SINE_RULE = SineRuleCurvature()


def _links(chain: Chain) -> tuple[Float[Array, " bonds"], Float[Array, " bonds"]]:
    """Arclength of each joint, and the length of its fibre."""
    return chain.arclength[:-1] + chain.reach[:-1], chain.length[chain.fibre_of_bead[:-1]]


class JointRepulsion(eqx.Module):
    """Repulsion of neighbours in the Joint Model, eqs (43)-(45), which keeps bent chains from overlap.

    Its scale is F_0 = C_1 F_v + C_2 sqrt(K_b E_b / L^3), with E_b = sum of K_b (kappa - kappa_0)^2 a.
    The print lacks the (smallest) radius a, without which F_0 would depend on the unit of length.

    **Arguments**

    - `viscous`: C_1 F_v [force]. The paper takes F_v = 6 pi mu L |v - v_inf| from the motion itself,
      which here is the outcome; give the drag force that the scene implies (a fibre's weight; 0
      for a fibre on which no force acts).
    - `elastic`: C_2.
    - `roughness`: delta_D over the half bond length a + eps_g.
    - `decay`: d_0 over the half bond length.

    **Raises** `ValueError` for negative numbers and lengths that are not positive.

    >>> from jaxbeads.force import JointBending, JointRepulsion
    >>> weight = 31.0  # of the whole fibre
    >>> force = JointBending(157.0, repulsion=JointRepulsion(viscous=0.01 * weight, elastic=0.01))
    >>> print(force.repulsion.viscous)
    0.31
    """

    viscous: Float[Array, ""] = eqx.field(converter=float_array, default=0.0)
    elastic: Float[Array, ""] = eqx.field(converter=float_array, default=0.5)
    roughness: Float[Array, ""] = eqx.field(converter=float_array, default=0.2)
    decay: Float[Array, ""] = eqx.field(converter=float_array, default=0.25)

    def __check_init__(self) -> None:
        for name in ("viscous", "elastic", "roughness", "decay"):
            shape(name, getattr(self, name), ())
        non_negative("viscous", self.viscous)
        non_negative("elastic", self.elastic)
        positive("roughness", self.roughness)
        positive("decay", self.decay)


class JointBending(AbstractForce):
    """Bending moments m_i = K_b (kappa_i - kappa_0) b at the joints of `Joint`, as torques on the beads:
    gamma_i = m_i - m_{i-1}, eq. (47).

    The curvature is that of the turn phi from one director to the next over the bond length
    2 (a + eps_g): by default it is sin(phi/2) / (a + eps_g), half of eq. (46) as it is printed,
    which would make the chain twice as stiff as `Bending`'s.

    **Arguments**

    - `rigidity`: K_b [force length^2], one for all joints or one each, `(beads - 1,)`.
    - `intrinsic_curvature`: as for `Bending`, at the joints, `(beads - 1,)` or `(beads - 1, 3)`.
    - `discrete_curvature`: `SineRuleCurvature()` (46) or `CrossProductCurvature()`.
    - `repulsion`: between neighbours, a `JointRepulsion`, or `None`.

    **Raises** `ValueError` for a negative rigidity, values that are not finite, or wrong shapes.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import JointBending
    >>> chain = jb.Chain(radius=1.0, fibres=2, gap=0.1)
    >>> bent = jb.from_directors(chain, [[1.0, 0.0], [0.0, 1.0]])
    >>> torque = JointBending(rigidity=10.0).load(jnp.zeros(()), bent, jb.Setting(chain, 1.0)).torque
    >>> print(torque.round(4).ravel())  # 10 sin(45 degrees)/1.1
    [ 6.4282 -6.4282]
    """

    rotational: ClassVar[bool] = True
    smooth: ClassVar[bool] = True
    oriented: ClassVar[bool] = True
    stiff: ClassVar[bool] = True
    internal: ClassVar[bool] = True
    rigidity: Array
    intrinsic_curvature: Curvature
    discrete_curvature: AbstractDiscreteCurvature
    repulsion: JointRepulsion | None

    def __init__(
        self,
        rigidity: Any,
        intrinsic_curvature: Any = 0.0,
        discrete_curvature: AbstractDiscreteCurvature = _SINE_RULE,
        repulsion: JointRepulsion | None = None,
    ) -> None:
        self.rigidity = float_array(rigidity)
        self.intrinsic_curvature = curvature_at_rest(intrinsic_curvature)
        self.discrete_curvature = discrete_curvature
        self.repulsion = repulsion

    def __check_init__(self) -> None:
        kind("discrete_curvature", self.discrete_curvature, AbstractDiscreteCurvature)
        if self.repulsion is not None:
            kind("repulsion", self.repulsion, JointRepulsion)
        check_bending(self.rigidity, self.intrinsic_curvature, spatial=True)

    def moments(
        self, t: Float[Array, ""], state: State, chain: Chain
    ) -> Float[Array, "bonds spins"]:
        """Moment at each joint [force length]; zero between fibres."""
        p = state.director
        if p is None:
            fail("state", "hold directors for JointBending", "it holds none")
        rest = self.intrinsic_curvature
        if isinstance(rest, jax.Array):
            rest = rest if rest.ndim else jnp.broadcast_to(rest, (len(p) - 1,))
        else:
            name = "JointBending.intrinsic_curvature"
            rest = rest_at(name, rest, t, *_links(chain), p.shape[1])
        rest = oriented(rest, p[:-1], p[1:])
        m = moments(self.rigidity, self.discrete_curvature, p[:-1], p[1:], chain.bond_length, rest)
        return m * chain.bond_mask[:, None]

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """Torques on the beads, and forces between neighbours that repel each other."""
        chain = scene.chain
        if chain.beads < 2:
            return Load()
        m = self.moments(t, state, chain)
        torque = jnp.pad(m, ((0, 1), (0, 0))) - jnp.pad(m, ((1, 0), (0, 0)))
        if self.repulsion is None:
            return Load(torque=torque)
        rigidity = jnp.broadcast_to(self.rigidity, m.shape[:1])
        # Not the square of K_b kappa, nor K_b E_b, which single precision may not hold.
        bent = m / jnp.where(rigidity == 0, 1.0, rigidity)[:, None]
        joint = rigidity * jnp.sum(bent * bent, axis=1)
        fibre = chain.fibre_of_bead
        member = (fibre[:-1] == np.arange(len(chain.fibres))[:, None]) & chain.bond_mask
        energy = jnp.min(chain.radius) * (member.astype(float) @ joint)
        most = jnp.max(rigidity[None, :], axis=1, where=member, initial=0.0)  # of each fibre
        scale = most / chain.length**2 * (energy / chain.length)
        scale = jnp.sqrt(jnp.where(energy == 0, 1.0, scale))
        scale = self.repulsion.viscous + self.repulsion.elastic * jnp.where(energy == 0, 0.0, scale)
        d = bonds(state.position)
        gap = norm(d) - chain.radii[:-1] - chain.radii[1:]
        half = 0.5 * chain.bond_length
        profile = repulsion(gap, self.repulsion.roughness * half, self.repulsion.decay * half)
        push = (scale[fibre[:-1]] * profile * chain.bond_mask)[:, None] * unit(d)
        force = jnp.pad(push, ((1, 0), (0, 0))) - jnp.pad(push, ((0, 1), (0, 0)))
        return Load(force, torque)

    def check(self, chain: Chain, dim: int) -> None:
        """Shapes that fit the joints."""
        joints, name = max(chain.beads - 1, 0), type(self).__name__
        shape(f"{name}.rigidity", self.rigidity, (), (joints,))
        dtype = chain.radius.dtype
        along(f"{name}.intrinsic_curvature", self.intrinsic_curvature, joints, dim, dtype)

    def explicit_step(self, scene: Setting) -> Float[Array, ""]:
        """A fifth of the paper's step (39), and as far below AB3's limit: a joint's moment turns single
        beads, whose fastest rate is about 4 (K_b / l) / (8 pi mu a^3).
        """
        chain = scene.chain
        most = stiffest(self.rigidity, chain.bond_mask)
        radius = jnp.min(chain.radius)
        step = scene.viscosity * radius**2 / jnp.where(most == 0, 1.0, most)
        return jnp.where(most == 0, jnp.inf, step * radius * 3 * (radius + chain.gap))
