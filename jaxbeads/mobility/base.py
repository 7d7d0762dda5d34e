"""What a mobility is, and its value at one configuration."""

import abc
from collections.abc import Callable
from typing import ClassVar, Protocol, runtime_checkable

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int

from .._checks import fail
from ..configuration import Configuration
from ..domain import SYMMETRIES, AbstractDomain, Unbounded
from ..flow import AbstractFlow
from ..pairs import PairTensor
from ..setting import Setting
from ..state import Load, Motion, add_motions

MOST_DENSE = 1000
"""Beads up to which a mobility is dense unless it is told otherwise."""

Strain = Callable[[Float[Array, "beads dim"]], Float[Array, "*beads dim dim"]]
"""The ambient rate of strain [1/time] at positions: one tensor for all beads, or one for each."""


class AbstractMobility(eqx.Module):
    """Linear relation of loads and motion in Stokes flow, for any configuration of beads.

    Qdot = M(Q) F + V_inf + C(Q) : E, eq. (13) of Delmotte, Climent & Plouraboué (2015). `motion`, M F,
    is all that a new mobility has to say: a pure function of the configuration, linear in the load and
    symmetric, so that its transpose is itself. `disturbance` is C : E, for beads that feel one
    another's resistance to strain. The rest makes it faster: with `tables` the matrices of constraints
    are assembled from fields of pairs (and large scenes are iterated), `gradient` finds the derivatives
    by the positions for pairs, `product`, `coarse` and `among` are what implicit steps of large scenes
    iterate. `fluid_velocity`, if it knows of a fluid between the beads, is what `flow_field` shows.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> class Porous(jb.mobility.AbstractMobility):  # every bead with the same drag
    ...     drag: float
    ...     def motion(self, configuration, load):
    ...         return jb.Motion(load.force / self.drag)
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> scene = jb.Scene(chain, 1.0, Porous(4.0), forces=[jb.force.Weight([0.0, -1.0])])
    >>> print(jb.dynamics.motion(0.0, jb.straight(chain, [1.0, 0.0]), scene).velocity)
    [[ 0.   -0.25]
     [ 0.   -0.25]]
    """

    interacting: ClassVar[bool] = True
    """Whether beads move one another, so that two of one size in one place move as one."""
    domains: ClassVar[tuple[type[AbstractDomain], ...]] = (Unbounded,)
    """The domains in which it holds."""
    symmetries: ClassVar[frozenset[str]] = SYMMETRIES
    """Those of `SYMMETRIES` that it has where the domain has them."""
    tabulated: ClassVar[bool] = False
    """Whether products with the tables of all beads are faster than `motion`."""

    def is_dense(self, beads: int) -> bool:
        """Whether the multipliers of so many beads are found by a factorisation; otherwise by
        iterations, for which it needs `tables` of some of the beads.
        """
        return True

    def check(self, scene: Setting, flow: AbstractFlow | None, dim: int) -> None:
        """Refuse, in one sentence, a domain, radii or a flow for which the mobility does not hold."""
        if not isinstance(scene.domain, self.domains):
            served = " or ".join(d.__name__ for d in self.domains)
            must = f"have the domain {served} for the mobility {type(self).__name__}"
            fail("scene", must, f"its domain is {type(scene.domain).__name__}")

    @abc.abstractmethod
    def motion(self, configuration: Configuration, load: Load) -> Motion:
        """M F, in the form that is differentiated; without spins unless they take part."""

    def product(self, configuration: Configuration, load: Load, exact: bool = True) -> Motion:
        """M F where it is not differentiated, within iterations: `motion`, unless it can be had faster,
        and to an error that the mobility allows unless it is to be `exact`.
        """
        return self.motion(configuration, load)

    def coarse(self, configuration: Configuration, load: Load) -> Motion | None:
        """M F to a percent or so, for iterations that find what it leaves out by a few products; `None`
        if there is none that is much faster.
        """
        return None

    def among(self, configuration: Configuration, load: Load) -> Motion | None:
        """M F of some beads of a large scene, if it can be had faster than by `tables`."""
        return None

    def disturbance(
        self, configuration: Configuration, strain_rate: Float[Array, "*beads dim dim"]
    ) -> Motion | None:
        """C : E for the ambient rate of strain at the beads [1/time], one for all or one for each;
        `None` if there is none.
        """
        return None

    def tables(self, configuration: Configuration) -> PairTensor | None:
        """M as fields of pairs; `None` if it has no such form."""
        return None

    def fluid_velocity(
        self,
        configuration: Configuration,
        load: Load,
        strain_rate: Float[Array, "*beads 3 3"] | None,
        points: Float[Array, "points 3"],
    ) -> Float[Array, "points 3"] | None:
        """Velocity of the fluid at points [length/time] that loads and the beads' resistance to a rate
        of strain drive, beside the ambient flow: that of which M and C are means over beads. All is in
        space. `None` if it knows of no fluid.
        """
        return None

    def gradient(
        self,
        configuration: Configuration,
        load: Load,
        strain: Strain | None,
        shifts: Float[Array, "shifts beads dim"],
    ) -> Motion | None:
        """Derivatives of M F + C:E along shifts of the positions [length], with F held, for implicit
        solvers: one shift after the other, vectorised, unless a mobility knows better.

        **Returns** motions with a leading axis of shifts; `None` if nothing depends on the positions.
        """

        def moved(x: Array) -> Motion:
            here = configuration.at(x)
            motion = self.motion(here, load)
            disturbance = None if strain is None else self.disturbance(here, strain(x))
            return motion if disturbance is None else add_motions(motion, disturbance)

        _, push = jax.linearize(moved, configuration.position)
        return jax.vmap(push)(shifts)

    def operator(self, configuration: Configuration) -> "Operator":
        """M at a configuration."""
        return Operator(self, configuration)


@runtime_checkable
class Product(Protocol):
    """Anything that takes loads to motions: an `Operator`, or its tables.

    >>> import jaxbeads as jb
    >>> from jaxbeads.mobility import RPY, Product
    >>> pair = jb.Configuration([[0.0, 0.0], [4.0, 0.0]], radius=1.0, viscosity=1.0)
    >>> print(isinstance(RPY().operator(pair), Product), isinstance(RPY().tables(pair), Product))
    True True
    """

    def motion(self, load: Load) -> Motion:
        """M F."""
        ...


class Operator(eqx.Module):
    """The mobility at one configuration, of which nothing is kept: every product is found anew.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> pair = jb.Configuration([[0.0, 0.0], [4.0, 0.0]], radius=1.0, viscosity=1.0)
    >>> operator = jb.mobility.RPY().operator(pair)
    >>> print((6 * jnp.pi * operator.motion(jb.Load(force=jnp.eye(2))).velocity).round(4))
    [[1.     0.1953]
     [0.3594 1.    ]]
    """

    mobility: AbstractMobility
    configuration: Configuration

    def motion(self, load: Load) -> Motion:
        """M F."""
        return self.mobility.motion(self.configuration, load)

    def product(self, load: Load, exact: bool = True) -> Motion:
        """M F, not to be differentiated."""
        return self.mobility.product(self.configuration, load, exact)

    def coarse(self, load: Load) -> Motion | None:
        """M F about, if that is much faster, not to be differentiated."""
        return self.mobility.coarse(self.configuration, load)

    def disturbance(self, strain_rate: Float[Array, "*beads dim dim"]) -> Motion | None:
        """C : E."""
        return self.mobility.disturbance(self.configuration, strain_rate)

    def gradient(
        self, load: Load, strain: Strain | None, shifts: Float[Array, "shifts beads dim"]
    ) -> Motion | None:
        """Derivatives of M F + C:E along shifts of the positions."""
        return self.mobility.gradient(self.configuration, load, strain, shifts)

    def some(self, beads: Int[Array, " some"]) -> PairTensor:
        """The mobility of some beads, as tables."""
        tables = self.mobility.tables(self.configuration.some(beads))
        if tables is None:
            must = "have `tables` for scenes without a dense mobility"
            fail("scene.mobility", must, f"{type(self.mobility).__name__} has none")
        return tables

    def among(self, beads: Int[Array, " some"], load: Load) -> Motion:
        """What loads of some beads do to them, not to be differentiated, one set of loads at a time."""
        found = self.mobility.among(self.configuration.some(beads), load)
        return self.some(beads).motion(load) if found is None else found

    def kept(self) -> Product:
        """What multiplies many loads in the shortest time: tables, if they are worth it."""
        mobility, configuration = self.mobility, self.configuration
        if not (mobility.tabulated and mobility.is_dense(configuration.beads)):
            return self
        tables = mobility.tables(configuration)
        return self if tables is None else tables
