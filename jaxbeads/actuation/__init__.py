"""Laws of time that drive fibres.

Preferred curvature, for `Bending(rigidity, intrinsic_curvature=...)` and, one for each of two axes of
the material (helical waves), for `ElasticRod`: `TravellingWave`, `TwoStrokes` (cilia),
`FourierCurvature`. Directions, for `PrescribedDirection` and `PrescribedPosition`: `PlanarBeat`,
`HelicalBeat`. Any function of the same form serves as well; one with parameters to be varied is an
`equinox.Module`.
"""

from .base import AbstractCurvature as AbstractCurvature
from .beat import HelicalBeat as HelicalBeat
from .beat import PlanarBeat as PlanarBeat
from .fourier import FourierCurvature as FourierCurvature
from .strokes import TwoStrokes as TwoStrokes
from .wave import TravellingWave as TravellingWave
