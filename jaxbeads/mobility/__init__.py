"""Mobilities: how forces and torques on beads move them through the fluid.

`FreeDraining` (no hydrodynamic interactions), `RPY` (Rotne-Prager-Yamakawa). A new one is a class
derived from `AbstractMobility` in a file of its own, a line here and a line in `tests/cases.py`.
"""

from .base import AbstractMobility as AbstractMobility
from .base import Operator as Operator
from .base import Product as Product
from .free_draining import FreeDraining as FreeDraining
from .rpy import RPY as RPY
