"""Solvers: ways to advance a state in time.

A solver carries its own options and declares what it can do, see `AbstractSolver`. `AB3` is the paper's
scheme, `Rosenbrock` the one for stiff scenes, `ESDIRK` that for large ones; `Diffrax` holds any solver
of `diffrax`. A new one is a class derived from `AbstractSolver` with a scheme derived from
`diffrax.AbstractSolver`, in a file of its own, a line here and a line in `tests/cases.py`.
"""

from .ab3 import AB3 as AB3
from .base import AbstractSolver as AbstractSolver
from .esdirk import ESDIRK as ESDIRK
from .explicit import explicit_step as explicit_step
from .explicit import substeps_for as substeps_for
from .rosenbrock import Rosenbrock as Rosenbrock
from .stepping import AdaptiveSteps as AdaptiveSteps
from .stepping import FixedSteps as FixedSteps
from .wrapped import Diffrax as Diffrax
