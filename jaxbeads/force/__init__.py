"""Forces and torques on beads.

Elasticity: `Bending` (torques), `BendingEnergy` (the same as a potential), `ElasticRod` (with twist, in
space), `JointBending` (of the Joint Model, with `JointRepulsion`), `Spring`. Active: `DrivingMoment`,
`Follower`, `EndTorque`. Magnets in a field of `jaxbeads.magnetism`: `MagneticFibre`, `MagneticBeads`,
`ParamagneticFibre`, `ParamagneticBeads`. Others: `Weight`, `Contact`, and a user's function as
`ForceField` or `Potential`. A new one is a class derived from `AbstractForce` or `AbstractPotential` in
a file of its own, a line here and a line in `tests/cases.py`.
"""

from .base import AbstractForce as AbstractForce
from .base import AbstractPotential as AbstractPotential
from .base import AbstractTouching as AbstractTouching
from .bending import Bending as Bending
from .bending import BendingEnergy as BendingEnergy
from .bending import DrivingMoment as DrivingMoment
from .contact import Contact as Contact
from .curvature import AbstractDiscreteCurvature as AbstractDiscreteCurvature
from .curvature import CrossProductCurvature as CrossProductCurvature
from .curvature import SineRuleCurvature as SineRuleCurvature
from .end_torque import EndTorque as EndTorque
from .field import ForceField as ForceField
from .field import Potential as Potential
from .follower import Follower as Follower
from .joint_bending import JointBending as JointBending
from .joint_bending import JointRepulsion as JointRepulsion
from .magnetic_beads import MagneticBeads as MagneticBeads
from .magnetic_fibre import MagneticFibre as MagneticFibre
from .paramagnetic_beads import ParamagneticBeads as ParamagneticBeads
from .paramagnetic_fibre import ParamagneticFibre as ParamagneticFibre
from .rod import ElasticRod as ElasticRod
from .spring import Spring as Spring
from .weight import Weight as Weight
