"""Kinematic constraints J Qdot + B = 0, enforced by Lagrange multipliers.

`Gears` (rolling contact of neighbours), `FrozenJoints` (infinite bending rigidity). A new one is a
class derived from `AbstractConstraint` in a file of its own, a line here and a line in
`tests/cases.py`.
"""

from .base import AbstractChainConstraint as AbstractChainConstraint
from .base import AbstractConstraint as AbstractConstraint
from .frozen import FrozenJoints as FrozenJoints
from .gears import Gears as Gears
