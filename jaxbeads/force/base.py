"""What a force is, and a force that follows from an energy."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..chain import Chain
from ..setting import Setting
from ..state import Load, State


class AbstractTouching(eqx.Module):
    """Pairs of beads that push each other apart, or may do so soon.

    >>> import jaxbeads as jb
    >>> two, touching = jb.Chain(radius=1.0, fibres=[1, 1]), jb.State([[0.0, 0.0], [2.0, 0.0]])
    >>> contact = jb.force.Contact(strength=3.0, roughness=0.1, decay=0.1)
    >>> pairs = contact.touching(touching, jb.Setting(two, viscosity=1.0), most=1)
    >>> gap = pairs.gap(touching.position)
    >>> print(pairs.first, pairs.second, gap, pairs.push(gap))
    [0] [1] [0.] [1.5]
    """

    first: eqx.AbstractVar[Int[Array, " pairs"]]
    second: eqx.AbstractVar[Int[Array, " pairs"]]
    direction: eqx.AbstractVar[Float[Array, "pairs dim"]]
    """From the second to the first; unit vectors."""
    there: eqx.AbstractVar[Bool[Array, " pairs"]]
    """Whether there is a pair."""

    @abc.abstractmethod
    def apart(self, position: Float[Array, "beads dim"]) -> Float[Array, "pairs dim"]:
        """r_i - r_j, of the first and the second [length]."""

    @abc.abstractmethod
    def gap(self, position: Float[Array, "beads dim"]) -> Float[Array, " pairs"]:
        """Distances of the surfaces [length]."""

    @abc.abstractmethod
    def push(self, gap: Float[Array, " pairs"]) -> Float[Array, " pairs"]:
        """Repulsion at distances of the surfaces [force]; it falls with the distance."""

    @property
    @abc.abstractmethod
    def deep(self) -> Float[Array, ""]:
        """A distance of surfaces at which repulsion is large already [length]."""


class AbstractForce(eqx.Module):
    """Loads on the beads as a function of time and state; of the scene it reads chain, viscosity and
    domain.

    >>> from typing import ClassVar
    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import AbstractForce
    >>> class Rising(AbstractForce):  # lighter than the fluid, and more so in time
    ...     rotational: ClassVar[bool] = False
    ...     def load(self, t, state, scene):
    ...         return jb.Load(force=jnp.zeros_like(state.position).at[:, 1].set(t))
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=1), 1.0, forces=[Rising()])
    >>> v = jb.dynamics.motion(6 * jnp.pi, jb.State([[0.0, 0.0]]), scene).velocity
    >>> print(v.round(12))  # F/(6 pi mu a)
    [[0. 1.]]
    """

    rotational: eqx.AbstractClassVar[bool]
    """Whether the load holds torques."""
    oriented: ClassVar[bool] = False
    """Whether the load depends on directors."""
    smooth: ClassVar[bool] = False
    """Whether the load changes little where a bead moves by less than its radius (true of loads that
    depend on the fibre's shape). Adaptive steps look along their path for what others do."""
    passes: ClassVar[bool] = False
    """Whether `passed` has something to say."""
    links: ClassVar[bool] = False
    """Whether it keeps neighbours together, as springs do."""
    internal: ClassVar[bool] = False
    """Whether it acts between neighbours of a fibre, with no force and no torque in all, as bending
    does: a fibre carries it along itself. (What `links` does so too.)"""
    stiff: ClassVar[bool] = False
    """Whether it is stiff, as bending is: true of a force that bounds explicit steps."""

    needs_frames: ClassVar[bool] = False
    """Whether the load depends on material frames (`State.frame`)."""

    @abc.abstractmethod
    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """Forces and torques on the beads."""

    def check(self, chain: Chain, dim: int) -> None:
        """Refuse a chain or a dimension that the force cannot serve, in one sentence."""

    def passed(self, before: State, after: State, scene: Setting) -> Bool[Array, ""]:
        """Whether beads that go straight from one state to another pass something that acts on them on
        the way, but at neither end: such a step is tried again with a smaller one.
        """
        return jnp.zeros((), bool)

    def begin(self, state: State, scene: Setting) -> Float[Array, "..."] | None:
        """Numbers of order one, any shape, that the force owns: they start from these, change at
        `own_rate`, and are in `state.own` where the force is asked. `None`: it owns nothing.
        """
        return None

    def own_rate(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, "..."]:
        """Rate of change of what the force owns [1/time]."""
        return jnp.zeros_like(state.own)

    def local(
        self, t: Float[Array, ""], state: State, scene: Setting
    ) -> Float[Array, "beads dim dim"] | None:
        """Derivative of the force on each bead by the bead's own place [force/length], for a force
        between any beads of a large scene, as contact: implicit steps of such scenes look for their way
        with it instead of the whole derivative (and converge to the same). `None`: with the whole.
        """
        return None

    def touching(self, state: State, scene: Setting, most: int) -> AbstractTouching | None:
        """Of a force that has `local`: at most so many pairs of beads, from the nearest on, that are
        taken as pairs where implicit steps look for their way, with the whole law of their force and
        not the derivative by each bead's own place. `None`: no pairs.
        """
        return None

    def explicit_step(self, scene: Setting) -> Float[Array, ""]:
        """Time step [time] that is safe for explicit solvers where this force is stiff: half of AB3's
        limit, 6/11 over the fastest rate, or less. Infinite unless a force knows better.
        """
        return jnp.asarray(jnp.inf)


class AbstractPotential(AbstractForce):
    """A force that is minus the gradient of an energy. `energy` is all that it has to say.

    >>> from typing import ClassVar
    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import AbstractPotential
    >>> class Trap(AbstractPotential):
    ...     rotational: ClassVar[bool] = False
    ...     def energy(self, t, state, scene):
    ...         return 0.5 * jnp.sum(state.position**2)
    >>> setting = jb.Setting(jb.Chain(radius=1.0, fibres=1), viscosity=1.0)
    >>> print(Trap().load(jnp.zeros(()), jb.State([[3.0, 1.0]]), setting).force)
    [[-3. -1.]]
    """

    rotational: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def energy(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, ""]:
        """Energy of the configuration [force length]."""

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """F = -dE/dr."""

        def energy(position: Array) -> Array:
            return self.energy(t, eqx.tree_at(lambda s: s.position, state, position), scene)

        return Load(force=-jax.grad(energy)(state.position))


def repulsion(gap: Array, roughness: Array, decay: Array) -> Array:
    """Profile of the repulsive force between surfaces at the distance `gap`, eq. (43), over its scale:
    0 beyond the roughness, rising linearly to 1 at minus the roughness, exponential beyond.
    """
    deep = jnp.minimum(gap + roughness, 0.0)  # bounded where the other branch holds
    ramp = 0.5 - gap / (2 * roughness)
    return jnp.where(gap > roughness, 0.0, jnp.where(deep < 0, jnp.exp(-deep / decay), ramp))
