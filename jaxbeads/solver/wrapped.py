"""Solvers of `diffrax`, with options."""

import dataclasses

import diffrax
import equinox as eqx
import jax

from .._checks import described, fail
from .base import AbstractSolver


def _both_modes(wrapped: diffrax.AbstractSolver) -> diffrax.AbstractSolver:
    """Runge-Kutta stages in a loop that has derivatives in forward mode too, unless it is chosen."""
    if not isinstance(wrapped, diffrax.AbstractSolver):
        must = "be a diffrax solver object, as diffrax.Tsit5()"
        fail("wrapped", must, f"it is {described(wrapped)}")
    if getattr(wrapped, "scan_kind", "none") is None:
        return dataclasses.replace(wrapped, scan_kind="bounded")
    return wrapped


class Diffrax(AbstractSolver):
    """A solver of `diffrax`, as `Diffrax(diffrax.Tsit5(), tolerance=1e-8)`.

    What `diffrax` can do is known by its classes: one that estimates its error is an
    `AbstractAdaptiveSolver`, one that solves equations in a step an `AbstractImplicitSolver`.

    **Arguments**: `wrapped`, the solver; options as for `AbstractSolver`.

    **Raises** `ValueError` for an implicit solver without a `controller`, from which its root finder
    takes its tolerances, and as `AbstractSolver`.

    >>> import diffrax
    >>> from jaxbeads.solver import Diffrax
    >>> solver = Diffrax(diffrax.Tsit5(), tolerance=1e-8)
    >>> print(solver.name, solver.estimates_error, solver.tolerance)
    Tsit5 True 1e-08
    """

    wrapped: diffrax.AbstractSolver = eqx.field(converter=_both_modes)

    def __check_init__(self) -> None:
        equal = self.substeps is not None or not self.estimates_error
        if equal and self._missing:
            must = (
                "be given with an implicit solver, whose root finder takes its tolerances from it"
            )
            fail("controller", must, "it is None")

    @property
    def scheme(self) -> diffrax.AbstractSolver:
        """The solver of `diffrax`."""
        return self.wrapped

    @property
    def name(self) -> str:
        """That of the solver of `diffrax`."""
        return type(self.wrapped).__name__

    @property
    def needs_derivatives(self) -> bool:
        """True of implicit schemes."""
        return isinstance(self.scheme, diffrax.AbstractImplicitSolver)

    @property
    def _missing(self) -> list[str]:
        """Settings of the root finder that `diffrax` leaves to the controller."""
        if not isinstance(self.scheme, diffrax.AbstractImplicitSolver):
            return []
        finder = self.scheme.root_finder
        numbers = [
            n for n in ("rtol", "atol") if not isinstance(getattr(finder, n), (float, jax.Array))
        ]
        return numbers + ([] if callable(getattr(finder, "norm", None)) else ["norm"])

    def tuned(self, controller: diffrax.AbstractStepSizeController) -> AbstractSolver:
        """The same, with a root finder that is as accurate as the controller asks."""
        names = self._missing
        if not names:
            return self
        return eqx.tree_at(
            lambda s: [getattr(s.wrapped.root_finder, name) for name in names],
            self,
            [getattr(controller, name) for name in names],
        )
