"""Solvers: ways to advance a state in time.

`AB3` is the paper's scheme. Any solver of `diffrax` serves as well, with constant steps or with a
step-size controller. A new one is a class derived from `diffrax.AbstractSolver` in a file of its own,
a line here and a line in `tests/cases.py`.
"""

from .ab3 import AB3 as AB3
from .rosenbrock import Rosenbrock as Rosenbrock
from .stepping import AdaptiveSteps as AdaptiveSteps
from .stepping import FixedSteps as FixedSteps
from .stepping import explicit_step as explicit_step
from .stepping import substeps_for as substeps_for
