"""An elastic rod: bending about two axes of the material, and twist."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import material
from .._checks import fail, finite, non_negative, shape
from .._functions import along
from .._typing import float_array, optional_float_array
from ..chain import Chain
from ..geometry import bonds, norm
from ..setting import Setting
from ..state import Load, State
from .base import AbstractPotential
from .curvature import Curvature, check_bending, curvature_at_rest, rest_at, stiffest


def _span(chain: Chain) -> Float[Array, "joints 1"]:
    """Arclength of each joint."""
    return 0.5 * (chain.bond_length[1:] + chain.bond_length[:-1])[:, None]


class ElasticRod(AbstractPotential):
    """Bending and twist of a rod in space whose material frames are (d_1, d_2, t), the energy

        E = sum of l [K_1 (kappa_1 - kappa_01)^2 + K_2 (kappa_2 - kappa_02)^2]/2 at the inner beads
            + sum of l K_t (tau - tau_0)^2/2 of the bonds,

    with the curvatures about d_1 and d_2 and the twist of `material`. Its forces are -dE/dr, the frames
    being led along by the smallest rotations (so twist pushes a bent centreline), its torques -dE/dangle
    t: virtual work is met exactly, and in all there is no force and no torque. An isotropic rod bends as
    by `BendingEnergy`, and under `Gears` as by `Bending`. It serves any chain constraint but `Joint`.

    **Arguments**

    - `rigidity`: K_1 [force length^2], one or one for each joint, `(beads - 2,)`.
    - `twist_rigidity`: K_t [force length^2], one or one for each bond, `(beads - 1,)`.
    - `second_rigidity`: K_2; by default K_1, an isotropic rod.
    - `intrinsic_curvature`, `second_curvature`: kappa_01, kappa_02 [1/length], numbers or functions
      kappa_0(t, arclength, length) as those of `jaxbeads.actuation`: an active rod, whose waves turn
      with the material. Two equal ones a quarter of a period apart are a helical wave.
    - `intrinsic_twist`: tau_0 [1/length], one or one for each bond. At rest the rod is a helix of radius
      kappa_0/(kappa_0^2 + tau_0^2) and pitch 2 pi tau_0/(kappa_0^2 + tau_0^2).

    Where the start holds no frames, a run takes those of `with_frames`.

    **Raises** `ValueError` for a negative rigidity, values that are not finite, or wrong shapes; `check`
    refuses planar scenes.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import ElasticRod
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> straight, setting = jb.straight(chain, [1.0, 0.0, 0.0]), jb.Setting(chain, viscosity=1.0)
    >>> twisted = jb.with_frames(straight, chain, twist=[0.1, 0.3])
    >>> rod = ElasticRod(rigidity=7.0, twist_rigidity=5.0)
    >>> torque = rod.load(jnp.zeros(()), twisted, setting).torque
    >>> print(torque[:, 0].round(6))  # K_t times differences
    [ 0.5  1.  -1.5]
    """

    rotational: ClassVar[bool] = True
    smooth: ClassVar[bool] = True
    internal: ClassVar[bool] = True
    stiff: ClassVar[bool] = True
    needs_frames: ClassVar[bool] = True
    rigidity: Array
    twist_rigidity: Array
    second_rigidity: Array | None
    intrinsic_curvature: Curvature
    second_curvature: Curvature
    intrinsic_twist: Array

    def __init__(
        self,
        rigidity: Any,
        twist_rigidity: Any,
        second_rigidity: Any = None,
        intrinsic_curvature: Any = 0.0,
        second_curvature: Any = 0.0,
        intrinsic_twist: Any = 0.0,
    ) -> None:
        self.rigidity = float_array(rigidity)
        self.twist_rigidity = float_array(twist_rigidity)
        self.second_rigidity = optional_float_array(second_rigidity)
        self.intrinsic_curvature = curvature_at_rest(intrinsic_curvature)
        self.second_curvature = curvature_at_rest(second_curvature)
        self.intrinsic_twist = float_array(intrinsic_twist)

    def __check_init__(self) -> None:
        check_bending(self.rigidity, self.intrinsic_curvature, spatial=False)
        second = self.rigidity if self.second_rigidity is None else self.second_rigidity
        check_bending(second, self.second_curvature, spatial=False)
        for name in ("twist_rigidity", "intrinsic_twist"):
            value = getattr(self, name)
            if value.ndim > 1:
                must = "be one number or one for each bond"
                fail(name, must, f"it has shape {value.shape}")
            finite(name, value)
        non_negative("twist_rigidity", self.twist_rigidity)

    def check(self, chain: Chain, dim: int) -> None:
        """Shapes that fit joints and bonds, in space."""
        name, dtype = type(self).__name__, chain.radius.dtype
        if dim != 3:
            fail("state", f"be in space for {name}", "it is planar, where `Bending` bends fibres")
        joints, bonds = max(chain.beads - 2, 0), chain.beads - 1
        for of in ("rigidity", "second_rigidity"):
            if (value := getattr(self, of)) is not None:
                shape(f"{name}.{of}", value, (), (joints,))
        for of in ("twist_rigidity", "intrinsic_twist"):
            shape(f"{name}.{of}", getattr(self, of), (), (bonds,))
        for of in ("intrinsic_curvature", "second_curvature"):
            along(f"{name}.{of}", getattr(self, of), joints, 2, dtype)

    def energy(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, ""]:
        """Energy of the rod [force length], 0 of the shape at rest."""
        chain = scene.chain
        if chain.beads < 2:
            return jnp.zeros((), state.position.dtype)
        found = material.strains(state, chain)
        bending, twisting = self._moments(t, found, chain)
        bent = found.curvature - self._rest(t, chain)
        twisted = (found.twist - self.intrinsic_twist) * chain.bond_length
        return (jnp.sum(bending * bent * _span(chain)) + jnp.sum(twisting * twisted)) / 2

    def _rest(self, t: Array, chain: Chain) -> Float[Array, "joints 2"]:
        """kappa_01 and kappa_02."""
        fibre, name = chain.fibre_of_bead[1:-1], type(self).__name__
        given = chain.arclength[1:-1], chain.length[fibre], 2
        rest = [
            rest_at(f"{name}.{of}", getattr(self, of), t, *given)
            for of in ("intrinsic_curvature", "second_curvature")
        ]
        return jnp.stack(rest, axis=1)

    def _moments(
        self, t: Array, found: material.Strains, chain: Chain
    ) -> tuple[Float[Array, "joints 2"], Float[Array, " bonds"]]:
        """About d_1 and d_2 at the inner beads, and along the bonds [force length]; 0 at ends."""
        bent, twisted = found.curvature - self._rest(t, chain), found.twist - self.intrinsic_twist
        first = jnp.broadcast_to(self.rigidity, len(bent))
        second = first if self.second_rigidity is None else self.second_rigidity
        rigidity = jnp.stack([first, jnp.broadcast_to(second, len(bent))], axis=1)
        bending, twisting = rigidity * bent, self.twist_rigidity * twisted
        return bending * chain.joint_mask[:, None], twisting * chain.bond_mask

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """F = -dE/dr and T = -dE/dangle t.

        With the moments m_1, m_2 at the beads and m_3 of the bonds, bending has
        dE/de = +-(m_2 d_1 - m_1 d_2) for the bonds after and before a bead. As e turns, the smallest
        rotation from t to e turns what it leads by h . (dt + de), h = t x e/(1 + t . e), and so on to
        the next t: that is how twist feels the centreline.
        """
        chain = scene.chain
        if chain.beads < 2:
            return Load()
        if state.frame is None:
            state = material.with_frames(state, chain)
        found, bond = material.strains(state, chain), bonds(state.position)
        bending, m = self._moments(t, found, chain)
        e, along = found.bond, found.direction
        first, second = bending[:, :1], bending[:, 1:]
        turned = second * found.first[1:-1] - first * found.second[1:-1]
        span = norm(e[1:] + e[:-1])[:, None]
        lead = jnp.cross(along[1:-1], e[1:] - e[:-1]) / (2 + span)
        before, after = m[:-1, None], m[1:, None]
        both = (before + after) / jnp.where(span == 0, 1.0, span)
        push = jnp.pad(turned + lead * (after + both), ((1, 0), (0, 0)))
        push = push - jnp.pad(turned - lead * (before + both), ((0, 1), (0, 0)))
        length = norm(bond)[:, None]
        push = (push - material.dot(push, e) * e) / jnp.where(length == 0, 1.0, length)
        force = jnp.pad(push, ((0, 1), (0, 0))) - jnp.pad(push, ((1, 0), (0, 0)))
        bent = found.curvature * _span(chain)
        roll = bending[:, 1] * bent[:, 0] - bending[:, 0] * bent[:, 1]
        torque = jnp.pad(m, (0, 1)) - jnp.pad(m, (1, 0)) + jnp.pad(roll, 1)
        return Load(force, torque[:, None] * along)

    def explicit_step(self, scene: Setting) -> Float[Array, ""]:
        """Half of AB3's limit, 6/11 over the fastest rate: of bending at most 16 (K_b/l^3)/(6 pi mu a),
        as in `BendingEnergy`; of twist 4 (K_t/l)/(8 pi mu a^3).
        """
        chain = scene.chain
        radius, span = jnp.min(chain.radius), 2 * jnp.min(chain.radius + chain.gap)
        most = stiffest(self.rigidity, chain.joint_mask)
        if self.second_rigidity is not None:
            most = jnp.maximum(most, stiffest(self.second_rigidity, chain.joint_mask))
        twist = stiffest(self.twist_rigidity, chain.bond_mask)
        # Factor by factor: single precision may not hold l^4.
        drag = scene.viscosity * np.pi * radius * span
        bending = 6 / 16 * drag / jnp.where(most == 0, 1.0, most) * span**2
        rolling = 8 / 4 * drag / jnp.where(twist == 0, 1.0, twist) * radius**2
        bending = jnp.where(most == 0, jnp.inf, bending)
        return 3 / 11 * jnp.minimum(bending, jnp.where(twist == 0, jnp.inf, rolling))
