"""Bead models of one passive fibre, to be exchanged for one another in a scene."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..chain import Chain, from_directors, from_tangents
from ..constraint import AbstractConstraint, EqualSpins, FrozenJoints, Gears, Inextensible, Joint
from ..force import AbstractForce, Bending, BendingEnergy, JointBending, JointRepulsion, Spring
from ..mobility import RPY
from ..state import State

__all__ = [
    "GEARS",
    "JOINT",
    "MODELS",
    "SPRING",
    "AbstractModel",
    "GearsModel",
    "JointModel",
    "SpringModel",
]


class AbstractModel(eqx.Module):
    """How neighbouring beads of a fibre hold together.

    >>> from jaxbeads import scenes
    >>> for name, model in scenes.MODELS.items():
    ...     print(name, isinstance(model, scenes.AbstractModel), model.chain(1.0, 3).bond_length)
    gears True [2. 2.]
    joint True [2.2 2.2]
    spring True [2. 2.]
    """

    mobility: ClassVar[RPY] = RPY()

    @abc.abstractmethod
    def chain(self, radius: float, beads: int) -> Chain:
        """The beads."""

    @abc.abstractmethod
    def constraints(self, rigid: bool = False) -> tuple[AbstractConstraint, ...]:
        """What links them; of a fibre that cannot bend if `rigid`."""

    @abc.abstractmethod
    def elasticity(
        self, chain: Chain, rigidity: Any, intrinsic_curvature: Any = 0.0, drag: Any = 0.0
    ) -> tuple[AbstractForce, ...]:
        """Forces for a bending rigidity K_b. `drag` is the force on the whole fibre, a scale for
        repulsions.
        """

    @abc.abstractmethod
    def state(self, chain: Chain, angles: Any) -> State:
        """A planar fibre whose tangents have these angles from x [rad], one for each bead."""


def _directions(angles: Any) -> np.ndarray:
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


class GearsModel(AbstractModel):
    """Touching beads that roll on one another: the paper's model.

    >>> from jaxbeads import scenes
    >>> print(scenes.GearsModel().constraints(), scenes.GearsModel().constraints(rigid=True))
    (Gears(),) (Gears(), FrozenJoints())
    """

    def chain(self, radius: float, beads: int) -> Chain:
        """Touching beads."""
        return Chain(radius, beads)

    def constraints(self, rigid: bool = False) -> tuple[AbstractConstraint, ...]:
        """`Gears`, and `FrozenJoints`."""
        return (Gears(), FrozenJoints()) if rigid else (Gears(),)

    def elasticity(
        self, chain: Chain, rigidity: Any, intrinsic_curvature: Any = 0.0, drag: Any = 0.0
    ) -> tuple[AbstractForce, ...]:
        """`Bending`."""
        return (Bending(rigidity, intrinsic_curvature),)

    def state(self, chain: Chain, angles: Any) -> State:
        """Bonds along the angles of their first beads."""
        return State(from_tangents(chain, _directions(angles)[:-1]))


class JointModel(AbstractModel):
    """Spaced beads linked by ball-and-socket joints, with repulsion, section 2.6.2 of the paper.

    **Arguments**: `gap`: eps_g over the radius; `viscous`, `elastic`: C_1 and C_2 of eq. (44);
    `roughness`, `decay`: as in `JointRepulsion`. The defaults are those of the paper's settling fibre.

    >>> from jaxbeads import scenes
    >>> print(scenes.JointModel(gap=0.2).chain(1.0, 3).bond_length)  # 2 (a + eps_g)
    [2.4 2.4]
    """

    gap: float | Float[Array, ""] = 0.1
    viscous: float | Float[Array, ""] = 0.01
    elastic: float | Float[Array, ""] = 0.01
    roughness: float | Float[Array, ""] = 0.2
    decay: float | Float[Array, ""] = 0.25

    def chain(self, radius: float, beads: int) -> Chain:
        """Beads 2 (a + eps_g) apart."""
        return Chain(radius, beads, self.gap * radius)

    def constraints(self, rigid: bool = False) -> tuple[AbstractConstraint, ...]:
        """`Joint`, and `EqualSpins`."""
        return (Joint(), EqualSpins()) if rigid else (Joint(),)

    def elasticity(
        self, chain: Chain, rigidity: Any, intrinsic_curvature: Any = 0.0, drag: Any = 0.0
    ) -> tuple[AbstractForce, ...]:
        """`JointBending` with repulsion."""
        viscous = self.viscous * jnp.asarray(drag)
        repulsion = JointRepulsion(viscous, self.elastic, self.roughness, self.decay)
        return (JointBending(rigidity, intrinsic_curvature, repulsion=repulsion),)

    def state(self, chain: Chain, angles: Any) -> State:
        """Directors along the angles."""
        return from_directors(chain, _directions(angles))


class SpringModel(AbstractModel):
    """Touching beads held by springs; they do not turn and see no stresslets, eq. (1).

    **Argument**: `stretching`: k_s a^3 / K_b; 2 is that of an elastic cylinder of radius a.

    >>> from jaxbeads import scenes
    >>> model = scenes.SpringModel()
    >>> spring, bending = model.elasticity(model.chain(radius=2.0, beads=3), rigidity=8.0)
    >>> print(spring.stiffness)  # 2 K_b/a^3
    2.0
    """

    mobility: ClassVar[RPY] = RPY(strained=False)
    stretching: float | Float[Array, ""] = 2.0

    def chain(self, radius: float, beads: int) -> Chain:
        """Touching beads."""
        return Chain(radius, beads)

    def constraints(self, rigid: bool = False) -> tuple[AbstractConstraint, ...]:
        """None; a rigid one takes the limit of stiff springs."""
        return (Inextensible(), FrozenJoints()) if rigid else ()

    def elasticity(
        self, chain: Chain, rigidity: Any, intrinsic_curvature: Any = 0.0, drag: Any = 0.0
    ) -> tuple[AbstractForce, ...]:
        """`Spring` and `BendingEnergy`."""
        stiffness = self.stretching * jnp.asarray(rigidity) / chain.radius**3
        return Spring(stiffness), BendingEnergy(rigidity, intrinsic_curvature)

    def state(self, chain: Chain, angles: Any) -> State:
        """Bonds along the angles of their first beads."""
        return State(from_tangents(chain, _directions(angles)[:-1]))


GEARS = GearsModel()
JOINT = JointModel()
SPRING = SpringModel()
MODELS: dict[str, AbstractModel] = {"gears": GEARS, "joint": JOINT, "spring": SPRING}
"""Models by the names that the shell uses."""
