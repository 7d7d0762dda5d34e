"""Kinematic constraints J Qdot + B = 0, enforced by Lagrange multipliers.

Chains: `Gears` (rolling contact of neighbours), `Joint` (ball and socket), `Inextensible` (lengths of
bonds alone); rigid: `FrozenJoints` (infinite bending rigidity), `EqualSpins`; prescribed motion:
`PrescribedPosition`, `PrescribedSpin`, `PrescribedRoll`, `PrescribedDirection`, `PrescribedLengths`, and
the ends `clamped()` and `hinged()`. A new one is a class derived from `AbstractConstraint` in a file of
its own, a line here and a line in `tests/cases.py`.
"""

from .base import AbstractChainConstraint as AbstractChainConstraint
from .base import AbstractConstraint as AbstractConstraint
from .ends import clamped as clamped
from .ends import hinged as hinged
from .equal_spins import EqualSpins as EqualSpins
from .frozen import FrozenJoints as FrozenJoints
from .gears import Gears as Gears
from .inextensible import Inextensible as Inextensible
from .joint import Joint as Joint
from .prescribed import PrescribedDirection as PrescribedDirection
from .prescribed import PrescribedLengths as PrescribedLengths
from .prescribed import PrescribedPosition as PrescribedPosition
from .prescribed import PrescribedRoll as PrescribedRoll
from .prescribed import PrescribedSpin as PrescribedSpin
