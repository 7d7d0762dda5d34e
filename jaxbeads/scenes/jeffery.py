"""Jeffery orbit of a stiff free fibre in shear (section 3.1 of the paper)."""

import numpy as np

from .._checks import kind, positive, whole
from ..dimensionless import cox_aspect_ratio, jeffery_period
from ..flow import Shear
from ..observables import orbit_period, orientation
from ..scene import Scene
from ..solution import Solution
from .case import Case, ReadyMade, Value
from .models import GEARS, AbstractModel, JointModel

__all__ = ["JEFFERY", "jeffery"]

_UNGAPPED = JointModel(gap=0.0)  # a rigid fibre needs no room to bend, section 3.1


def jeffery(
    beads: int = 20,
    model: AbstractModel = GEARS,
    *,
    radius: float = 1.0,
    viscosity: float = 1.0,
    shear_rate: float = 1.0,
) -> Case:
    """A rigid fibre in simple shear, started along the gradient, for a little over half an orbit.

    Stiffness is taken to its limit by constraints (`FrozenJoints`, `EqualSpins`), so no fast bending
    rate bounds the time step (0.01 / shear rate). The Joint Model has no gap here. The Spring Model lies
    down along the flow and never turns over: it has no period.

    **Arguments**: number of beads (at least 2); bead model; a [length]; mu; shear rate.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.jeffery(beads=3, shear_rate=2.0)
    >>> print(case.scene.flow.rate, [type(c).__name__ for c in case.scene.constraints])
    2.0 ['Gears', 'FrozenJoints']
    """
    whole("beads", beads, 2)
    positive("shear_rate", shear_rate)
    kind("model", model, AbstractModel)
    model = _UNGAPPED if isinstance(model, JointModel) else model
    chain = model.chain(radius, beads)
    constraints = model.constraints(rigid=beads > 2 or isinstance(model, JointModel))
    scene = Scene(
        chain,
        viscosity,
        mobility=model.mobility,
        constraints=constraints,
        flow=Shear(shear_rate),
    )
    span = 0.75 * float(jeffery_period(cox_aspect_ratio(beads), shear_rate))
    saves = 20 * int(np.ceil(span * shear_rate / 0.05 / 20))
    ts = np.linspace(0, span, saves + 1)
    return Case(scene, model.state(chain, np.full(beads, np.pi / 2)), ts, 5, 1e-7)


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    flow = case.scene.flow
    rate = float(flow.rate) if isinstance(flow, Shear) else 1.0
    angle = np.unwrap(orientation(solution.states.position))
    if abs(angle[-1] - angle[0]) < np.pi:
        return {"period": None}
    return {"period": rate * orbit_period(solution.ts, solution.states.position)}


JEFFERY = ReadyMade(
    "jeffery",
    "Jeffery orbit of a stiff free fibre in shear: its period",
    jeffery,
    {"beads": "number of beads", "model": "gears, joint or spring"},
    _observables,
    {
        "period": "period of the orbit times the shear rate; none in less than half a turn",
    },
    ("orientation [rad]", lambda case, s: np.unwrap(orientation(s.states.position))),
    quick="--beads 4 --model joint",
)
