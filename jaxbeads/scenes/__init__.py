"""Ready-made scenes: one file each, with a function that builds it and one that measures it.

Passive fibres: `jeffery`, `shear`, `settling`, `relaxation`; driven ones: `planar_beating`,
`helical_beating`, `follower_force`; swimmers: `nematode`, `nematode_pair`, `spiral`,
`three_sphere`. Each returns a `Case` (scene, state, times and how to step); `case.simulate()` runs
it. A new one is a file here and a line in `SCENES`; the shell (`python -m jaxbeads`) shows what is
in that list. `GEARS`, `JOINT` and `SPRING` are bead models that may be exchanged for one another.
"""

from .beating import HELICAL_BEATING, PLANAR_BEATING
from .beating import helical_beating as helical_beating
from .beating import lateral_harmonic as lateral_harmonic
from .beating import planar_beating as planar_beating
from .case import Case as Case
from .case import ReadyMade as ReadyMade
from .case import Value as Value
from .case import last_period as last_period
from .case import lateral_modes as lateral_modes
from .follower_force import FOLLOWER_FORCE
from .follower_force import follower_force as follower_force
from .follower_force import growth_rates as growth_rates
from .jeffery import JEFFERY
from .jeffery import jeffery as jeffery
from .models import GEARS as GEARS
from .models import JOINT as JOINT
from .models import MODELS as MODELS
from .models import SPRING as SPRING
from .models import AbstractModel as AbstractModel
from .models import GearsModel as GearsModel
from .models import JointModel as JointModel
from .models import SpringModel as SpringModel
from .nematode import NEMATODE, NEMATODE_PAIR
from .nematode import nematode as nematode
from .nematode import nematode_pair as nematode_pair
from .relaxation import RELAXATION
from .relaxation import relaxation as relaxation
from .settling import SETTLING
from .settling import settling as settling
from .settling import settling_friction as settling_friction
from .shear import SHEAR
from .shear import shear as shear
from .spiral import SPIRAL
from .spiral import spiral as spiral
from .three_sphere import THREE_SPHERE
from .three_sphere import Arms as Arms
from .three_sphere import three_sphere as three_sphere

SCENES: tuple[ReadyMade, ...] = (
    JEFFERY,
    SHEAR,
    SETTLING,
    RELAXATION,
    PLANAR_BEATING,
    HELICAL_BEATING,
    FOLLOWER_FORCE,
    NEMATODE,
    NEMATODE_PAIR,
    SPIRAL,
    THREE_SPHERE,
)
"""All ready-made scenes, in the order in which the shell lists them."""
