"""Rigid bodies: `Body`, shapes of it, and the joints between them.

Shapes: `sphere` (one bead), `shell`, `ellipsoid`, `rod`, `helix`, `strand`, `read_points`. Joints:
`Weld` (two as one, or held), `Motor` (relative spin as told), `Hinge` (free or driven by a torque),
`Ball` (free, or a hook). `fibre` makes a flexible fibre of bodies with elastic joints. An `Assembly`
puts them into a fluid; `locomotion` says how they move at one instant, `travel` in time. A new joint is
a class derived from `AbstractJoint`.
"""

from .base import Body as Body
from .fibre import Fibre as Fibre
from .fibre import fibre as fibre
from .joints import AbstractJoint as AbstractJoint
from .joints import Ball as Ball
from .joints import Hinge as Hinge
from .joints import Motor as Motor
from .joints import Weld as Weld
from .shapes import ellipsoid as ellipsoid
from .shapes import helix as helix
from .shapes import read_points as read_points
from .shapes import rod as rod
from .shapes import shell as shell
from .shapes import sphere as sphere
from .shapes import strand as strand
