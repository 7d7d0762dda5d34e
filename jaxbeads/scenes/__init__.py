"""Ready-made scenes: one file each, with a function that builds it and one that measures it.

`jeffery`, `shear`, `settling` and `relaxation` return a `Case` (scene, state, times and how to step);
`case.simulate()` runs it. A new one is a file here and a line in `SCENES`; the shell
(`python -m jaxbeads`) shows what is in that list.
"""

from .case import Case as Case
from .case import ReadyMade as ReadyMade
from .jeffery import JEFFERY
from .jeffery import jeffery as jeffery
from .relaxation import RELAXATION
from .relaxation import relaxation as relaxation
from .settling import SETTLING
from .settling import settling as settling
from .settling import settling_friction as settling_friction
from .shear import SHEAR
from .shear import shear as shear

SCENES: tuple[ReadyMade, ...] = (JEFFERY, SHEAR, SETTLING, RELAXATION)
"""All ready-made scenes, in the order in which the shell lists them."""
