"""What a solver is: the scheme of a step, what it can do, and the options by which steps are chosen."""

import abc
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
from jaxtyping import Array, Float

from .._checks import fail, kind, known, positive, shape, whole
from .._typing import optional_float_array
from ..chain import Chain
from ..coordinates import AbstractCoordinates
from .tolerance import controller_for


class CubicPath(diffrax.AbstractLocalInterpolation):
    """States between the ends of a step: a cubic in the coordinates."""

    t0: Any
    t1: Any
    coordinates: AbstractCoordinates
    x1: Array
    bend: Array

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> Any:
        """State at t0, or its change from t0 to t1."""
        if t1 is not None:
            return jax.tree.map(lambda a, b: b - a, self.evaluate(t0), self.evaluate(t1))
        s = (t0 - self.t0) / (self.t1 - self.t0)
        first, second = self.bend
        return self.coordinates.state(s * (self.x1 + (1 - s) * (first + s * second)))


class AbstractSolver(eqx.Module):
    """A way to follow a scene in time, with its own options.

    A new one names its `scheme` and declares what it can do.

    **Arguments**, by name

    - `tolerance`: largest error of a step, as a fraction of the longest fibre's length, for a scheme
      that estimates it; by default 1e-6 (float32: 1e-4). A leaf: it may be traced and differentiated.
    - `substeps`: equal steps between two save times instead.
    - `controller`: a `diffrax` step-size controller instead.
    - `projected`: restore bond lengths after every step; by default with adaptive steps, unless the
      scheme keeps them by itself.
    - `max_steps`: bound on adaptive steps between two save times.

    **Raises** `ValueError` for options that exclude one another, a tolerance that is not positive, or
    one of a scheme that does not estimate its error.

    >>> import jaxbeads as jb
    >>> print(jb.Rosenbrock(tolerance=1e-8).estimates_error, jb.AB3(substeps=50).estimates_error)
    True False
    """

    equal_steps: ClassVar[bool] = False
    """Whether all its steps must be equally long."""
    keeps_bonds: ClassVar[bool] = False
    """Whether bonds keep their lengths by themselves."""
    needs_matrix: ClassVar[bool] = False
    """Whether it needs the linearisation as a matrix, and so a dense mobility."""
    implicit: ClassVar[bool] = False
    """Whether no rate of the scene bounds its steps; then they need derivatives of its terms."""
    stable_to: ClassVar[float | None] = None
    """Its longest stable step over `explicit_step`, if it is known."""
    evaluations: ClassVar[float] = 6
    """Evaluations of the velocities that take as long as a step, about: what a run tells beforehand."""
    hopeless: ClassVar[Any] = None
    """The result of a step where no smaller one would do better, if there is one."""

    tolerance: Float[Array, ""] | None = eqx.field(
        kw_only=True, default=None, converter=optional_float_array
    )
    substeps: int | None = eqx.field(kw_only=True, default=None, static=True)
    controller: diffrax.AbstractStepSizeController | None = eqx.field(kw_only=True, default=None)
    projected: bool | None = eqx.field(kw_only=True, default=None, static=True)
    max_steps: int = eqx.field(kw_only=True, default=100_000, static=True)

    def __check_init__(self) -> None:
        whole("max_steps", self.max_steps, 1)
        chosen = {"tolerance": self.tolerance, "controller": self.controller}
        for name, value in chosen.items():
            if value is not None and not self.estimates_error:
                must = "be None for a solver that does not estimate its error"
                fail(name, must, f"{self.name} does not")
        if self.tolerance is not None:
            shape("tolerance", self.tolerance, ())
            if self.substeps is not None or self.controller is not None:
                other = "substeps is given" if self.controller is None else "a controller is given"
                fail("tolerance", f"be None when {other}", f"it is {plain(self.tolerance)}")
            positive("tolerance", self.tolerance)
        if self.controller is not None:
            kind("controller", self.controller, diffrax.AbstractStepSizeController)
        if self.substeps is not None:
            whole("substeps", self.substeps, 1)
            if self.controller is not None:
                must = "be None when a controller chooses the steps"
                fail("substeps", must, f"it is {self.substeps}")

    @property
    @abc.abstractmethod
    def scheme(self) -> diffrax.AbstractSolver:
        """How a step is taken, as `diffrax` has it."""

    @property
    def name(self) -> str:
        """What it is called in solutions, files and messages."""
        return type(self).__name__

    @property
    def estimates_error(self) -> bool:
        """Whether a step estimates its error, so that its length can be chosen by it."""
        return isinstance(self.scheme, diffrax.AbstractAdaptiveSolver)

    @property
    def needs_derivatives(self) -> bool:
        """Whether a step needs derivatives of the scene's terms."""
        return self.implicit

    def controlled(
        self, tolerance: Float[Array, ""], chain: Chain
    ) -> diffrax.AbstractStepSizeController:
        """What a tolerance means."""
        return controller_for(tolerance, chain)

    def tuned(self, controller: diffrax.AbstractStepSizeController) -> "AbstractSolver":
        """The same, with what its scheme takes from the controller."""
        return self


def plain(number: Any) -> str:
    """A number in a message."""
    return f"{float(number):g}" if known(number) else "traced"
