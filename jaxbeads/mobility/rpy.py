"""Rotne-Prager-Yamakawa: the beads' far-field interactions, regular at any distance."""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Float

from .. import fields, images, mirror, products, segments, tensors
from .._checks import fail, whole
from ..configuration import Configuration
from ..domain import AbstractDomain, FreeSurface, NoSlipWall, Unbounded
from ..pairs import PairTensor
from ..shares import shared_out
from ..state import Load, Motion, add_motions
from .base import MOST_DENSE, AbstractMobility, Strain


class _Form(NamedTuple):
    """The sums over pairs in one kind of domain."""

    motion: Callable[[Configuration, Load], Motion]
    disturbance: Callable[[Configuration, Array], Motion]
    tables: Callable[[Configuration], PairTensor]
    fluid: Callable[[Configuration, Load, Array | None, Array], Array]
    gradient: Callable[[Configuration, Load, Array], Motion] | None = None
    """Derivatives of M F by the positions, if they are found for pairs."""


_FREE = _Form(tensors.rpy_motion, tensors.shear_disturbance, tensors.rpy, fields.unbounded)
_FORMS: dict[type[AbstractDomain], _Form] = {
    Unbounded: _FREE,
    NoSlipWall: _Form(
        images.motion, images.disturbance, images.tables, fields.near_wall, images.gradient
    ),
    FreeSurface: _Form(mirror.motion, mirror.disturbance, mirror.tables, fields.near_surface),
}
"""A new domain is a line here."""


def _form(configuration: Configuration) -> _Form:
    fitting = (form for kind, form in _FORMS.items() if isinstance(configuration.domain, kind))
    return next(fitting, _FREE)


class RPY(AbstractMobility):
    """Rotne-Prager-Yamakawa mobility in an unbounded fluid or a half space, for translation alone or
    with rotation (as the scene's other terms need), with the shear-disturbance tensor C.

    Exact to order (a/R)^3 for separate beads and positive definite in every configuration,
    overlapping included; no lubrication. Formulas and sources: `jaxbeads.tensors`; of a no-slip wall
    `jaxbeads.images`, of a free surface `jaxbeads.mirror`.

    **Arguments**

    - `strained`: whether beads resist the strain of the ambient flow (C); without it they are carried
      as points, which many bead models assume.
    - `dense`: whether the mobility is kept as tables of `(beads, beads)` and the multipliers are found
      by a factorisation. Otherwise pairs are summed anew for each product, multipliers are iterated
      (to 1e-12), and memory grows like the number of beads; steps are those of `ESDIRK` or explicit,
      and steady states need the tables. By default up to 1000 beads.
    - `far_error`: error of the velocities, over the largest, that the influence of beads far away may
      have in the steps of `ESDIRK` in an unbounded fluid, where there are no tables; from 1e-6 on they
      are in single precision, and from 2000 beads in long fibres on their segments interact by a
      few beads (`jaxbeads.segments`), in most iterations by fewer still. Derivatives are those of the
      exact sums. 0: none but rounding.
    - `devices`: how many devices share the pairs of beads out among them, where it is not dense (0: all,
      of all processes). By default one does all. Results are the same to rounding.

    For JAX a machine's cores are one device unless it is told otherwise, before it is first used, by
    `jax.config.update("jax_num_cpu_devices", 2)` or in the shell:

        XLA_FLAGS=--xla_force_host_platform_device_count=2 python run.py

    Several processes run the same program, after `jax.distributed.initialize("localhost:12345", 2, 0)`
    in the first and `("localhost:12345", 2, 1)` in the second (clusters tell it these numbers), and go
    through `rollout`, whose steps depend on no clock.

    **Raises** `ValueError` for an error that is not between 1e-10 and 1e-3, or 0.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> pair = jb.Configuration([[0.0, 0.0], [4.0, 0.0]], radius=1.0, viscosity=1.0)
    >>> load = jb.Load(force=jnp.array([[6 * jnp.pi, 0.0], [0.0, 0.0]]))
    >>> print(jb.mobility.RPY().motion(pair, load).velocity.round(6))  # 3a/(2R) - (a/R)^3
    [[1.       0.      ]
     [0.359375 0.      ]]
    """

    tabulated: ClassVar[bool] = True
    domains: ClassVar[tuple[type[AbstractDomain], ...]] = tuple(_FORMS)
    strained: bool = eqx.field(static=True, default=True)
    dense: bool | None = eqx.field(static=True, default=None)
    far_error: float = eqx.field(static=True, default=0.0, kw_only=True)
    devices: int | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self) -> None:
        if self.far_error != 0 and not 1e-10 <= self.far_error <= 1e-3:
            fail("far_error", "be 0 or between 1e-10 and 1e-3", f"it is {self.far_error:g}")
        if self.devices is not None:
            whole("devices", self.devices, 0)

    def is_dense(self, beads: int) -> bool:
        """As `dense` says."""
        return beads <= MOST_DENSE if self.dense is None else self.dense

    def motion(self, configuration: Configuration, load: Load) -> Motion:
        """M F, pair by pair."""
        with shared_out(self.devices):
            return _form(configuration).motion(configuration, load)

    def product(self, configuration: Configuration, load: Load, exact: bool = True) -> Motion:
        """M F by blocks of beads, to `far_error` unless it is to be exact."""
        if _form(configuration) is not _FREE:
            return self.motion(configuration, load)
        with shared_out(self.devices):
            if self.far_error and not exact:
                return segments.motion(configuration, load, self.far_error)
            return products.motion(configuration, load)

    def coarse(self, configuration: Configuration, load: Load) -> Motion | None:
        """M F by segments with few nodes, where they are what `product` uses."""
        if _form(configuration) is not _FREE or not self.far_error:
            return None
        with shared_out(self.devices):
            return segments.coarse(configuration, load, self.far_error)

    def among(self, configuration: Configuration, load: Load) -> Motion | None:
        """M F as of separate spheres, if they are."""
        if _form(configuration) is not _FREE or not products.plain(configuration):
            return None
        return products.among(configuration, load)

    def disturbance(
        self, configuration: Configuration, strain_rate: Float[Array, "*beads dim dim"]
    ) -> Motion | None:
        """C : E."""
        if not self.strained:
            return None
        with shared_out(self.devices):
            return _form(configuration).disturbance(configuration, strain_rate)

    def tables(self, configuration: Configuration) -> PairTensor:
        """All pair tensors as `(beads, beads)` fields."""
        return _form(configuration).tables(configuration)

    def fluid_velocity(
        self,
        configuration: Configuration,
        load: Load,
        strain_rate: Float[Array, "*beads 3 3"] | None,
        points: Float[Array, "points 3"],
    ) -> Float[Array, "points 3"]:
        """The flows of single spheres, added up."""
        rate = strain_rate if self.strained else None
        return _form(configuration).fluid(configuration, load, rate, points)

    def gradient(
        self,
        configuration: Configuration,
        load: Load,
        strain: Strain | None,
        shifts: Float[Array, "shifts beads dim"],
    ) -> Motion | None:
        """Derivatives of M F + C:E, found for pairs (but for C near boundaries)."""
        strain = strain if self.strained else None
        if load.force is None and load.torque is None and strain is None:
            return None
        form = _form(configuration)
        if form is _FREE:
            return tensors.rpy_gradient(configuration, load, strain, shifts)
        if form.gradient is None or (load.force is None and load.torque is None):
            return super().gradient(configuration, load, strain, shifts)
        moved = form.gradient(configuration, load, shifts)
        if strain is None:
            return moved
        disturbance, rate = form.disturbance, strain
        _, push = jax.linearize(
            lambda x: disturbance(configuration.at(x), rate(x)), configuration.position
        )
        return add_motions(moved, jax.vmap(push)(shifts))
