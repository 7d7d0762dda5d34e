"""Ready-made scenes: one file each, with a function that builds it and one that measures it.

Passive fibres: `jeffery`, `shear`, `settling`, `relaxation`; driven ones: `planar_beating`,
`helical_beating`, `follower_force`; swimmers: `nematode`, `nematode_pair`, `spiral`,
`three_sphere`; at a no-slip wall: `cilium`, `cilia_row`, `settling_wall`, `nematode_wall`. Each
returns a `Case` (scene, state, times and how to step); `case.simulate()` runs it. A new one is a
file here, its import and its `ReadyMade` in `SCENES` below, where the shell (`python -m jaxbeads`) and
the tests of all scenes find it. `GEARS`, `JOINT` and `SPRING` are bead models that may be exchanged for
one another.
"""

from .beating import *
from .case import *
from .cilium import *
from .follower_force import *
from .jeffery import *
from .models import *
from .nematode import *
from .relaxation import *
from .settling import *
from .shear import *
from .spiral import *
from .three_sphere import *

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
    CILIUM,
    CILIA_ROW,
    SETTLING_WALL,
    NEMATODE_WALL,
)
"""All ready-made scenes, in the order of the README's table."""
