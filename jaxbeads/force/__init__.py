"""Forces and torques on beads.

`Bending` (torques), `BendingEnergy` (the same as a potential), `Weight`, `ForceField`, `Potential`.
A new one is a class derived from `AbstractForce` or `AbstractPotential` in a file of its own, a line
here and a line in `tests/cases.py`.
"""

from .base import AbstractForce as AbstractForce
from .base import AbstractPotential as AbstractPotential
from .bending import Bending as Bending
from .bending import BendingEnergy as BendingEnergy
from .bending import CrossProductCurvature as CrossProductCurvature
from .bending import SineRuleCurvature as SineRuleCurvature
from .field import ForceField as ForceField
from .field import Potential as Potential
from .weight import Weight as Weight
