"""Jeffery orbit of a stiff free fibre in shear (section 3.1 of the paper)."""

import numpy as np

from .._checks import positive, whole
from ..chain import Chain, straight
from ..constraint import FrozenJoints, Gears
from ..flow import Shear
from ..numbers import cox_aspect_ratio, jeffery_period
from ..observables import orbit_period, orientation
from ..rollout import Solution
from ..scene import Scene
from .case import Case, ReadyMade


def jeffery(
    beads: int = 20, *, radius: float = 1.0, viscosity: float = 1.0, shear_rate: float = 1.0
) -> Case:
    """A rigid Gears fibre in simple shear, started along the gradient, for a little over half an orbit.

    Stiffness is taken to its limit with `FrozenJoints`, so no fast bending rate bounds the time step
    (0.01 / shear rate). **Arguments**: number of beads (at least 2), a [length], mu, shear rate.
    """
    whole("beads", beads, 2)
    positive("shear_rate", shear_rate)
    chain = Chain(radius, beads)
    constraints = (Gears(), FrozenJoints()) if beads > 2 else (Gears(),)
    scene = Scene(chain, viscosity, constraints=constraints, flow=Shear(shear_rate))
    span = 0.75 * float(jeffery_period(cox_aspect_ratio(beads), shear_rate))
    saves = 20 * int(np.ceil(span * shear_rate / 0.05 / 20))
    ts = np.linspace(0, span, saves + 1)
    return Case(scene, straight(chain, [0.0, 1.0]), ts, substeps=5)


def _observables(case: Case, solution: Solution) -> dict[str, float]:
    flow = case.scene.flow
    rate = float(flow.rate) if isinstance(flow, Shear) else 1.0
    return {"period": rate * orbit_period(solution.ts, solution.states.position)}


JEFFERY = ReadyMade(
    "jeffery",
    "Jeffery orbit of a stiff free fibre in shear: its period",
    jeffery,
    {"beads": "number of beads"},
    _observables,
    ("orientation [rad]", lambda case, s: np.unwrap(orientation(s.states.position))),
)
