"""Ambient flows.

`Shear`, `Extension`, `LinearFlow` (any gradient), `OscillatingShear`, `Poiseuille`, `VelocityField`
(a user's function). A new one is a class derived from `AbstractFlow` (or `AbstractLinearFlow`) in a
file of its own, a line here and a line in `tests/cases.py`.
"""

from .base import AbstractFlow as AbstractFlow
from .base import AbstractLinearFlow as AbstractLinearFlow
from .field import VelocityField as VelocityField
from .linear import Extension as Extension
from .linear import LinearFlow as LinearFlow
from .linear import OscillatingShear as OscillatingShear
from .linear import Shear as Shear
from .poiseuille import Poiseuille as Poiseuille
