"""Ready-made scenes: one file each, with a function that builds it and one that measures it.

Passive fibres: `jeffery`, `shear`, `settling`, `relaxation`; driven ones: `planar_beating`,
`helical_beating`, `follower_force`; in space: `whirling`, `helix_formation`, `follower_force_3d`;
swimmers: `nematode`, `nematode_pair`, `spiral`, `three_sphere`; in a magnetic field: `magnetic_rod`,
`magnetic_swimmer`; at a no-slip wall: `cilium`, `cilia_row`, `settling_wall`, `nematode_wall`; many
fibres in space: `cloud`, `shear_suspension`; rigid bodies: `rigid_helix`, `bacterium`. Each returns a
`Case` (scene, state, times and how to step), of bodies an `AssemblyCase`; `case.simulate()` runs it.
A new one is a file here and a line below: the shell (`python -m jaxbeads`) and the tests of all scenes
find its `ReadyMade`. `GEARS`, `JOINT` and `SPRING` are bead models that may be exchanged for one
another.
"""

from .bacterium import *
from .beating import *
from .case import *
from .cilium import *
from .follower_force import *
from .follower_force_3d import *
from .helix_formation import *
from .jeffery import *
from .magnetic import *
from .models import *
from .nematode import *
from .relaxation import *
from .rigid_helix import *
from .settling import *
from .shear import *
from .spiral import *
from .suspension import *
from .three_sphere import *
from .whirling import *

SCENES: tuple[ReadyMade, ...] = tuple(
    ready for ready in dict(globals()).values() if isinstance(ready, ReadyMade)
)
"""All ready-made scenes, in the order of their files."""
