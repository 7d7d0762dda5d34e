"""Flexible free fibre tumbling in shear (section 3.2 of the paper)."""

import numpy as np

from .._checks import finite, kind, positive, whole
from ..dimensionless import cox_aspect_ratio, jeffery_period, rigidity_from_bending_ratio
from ..flow import Shear
from ..observables import minimal_radius_of_curvature
from ..scene import Scene
from ..solution import Solution
from .case import Case, ReadyMade, Value
from .models import GEARS, AbstractModel

__all__ = ["SHEAR", "shear"]


def shear(
    beads: int = 35,
    bending_ratio: float = 0.04,
    intrinsic_curvature: float = 0.01,
    model: AbstractModel = GEARS,
    *,
    radius: float = 1.0,
    viscosity: float = 1.0,
    shear_rate: float = 1.0,
) -> Case:
    """A flexible fibre in simple shear, started straight along the gradient.

    It swings into the flow direction and buckles during the tumble that follows, about half a period
    later; the run ends before the next one.

    **Arguments**: number of beads (at least 3); bending ratio BR, eq. (54), with r_e after Cox;
    intrinsic curvature times length, kappa_eq L (0: straight at rest, an S shape); bead model; a
    [length]; mu; shear rate.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> from jaxbeads.dimensionless import bending_ratio
    >>> case = scenes.shear(beads=4, bending_ratio=0.04)
    >>> print(f"{bending_ratio(case.scene.forces[0].rigidity, 1.0, 4, 1.0, 1.0):.4f}")
    0.0400
    """
    whole("beads", beads, 3)
    finite("intrinsic_curvature", intrinsic_curvature)
    for name, value in (
        ("bending_ratio", bending_ratio),
        ("radius", radius),
        ("viscosity", viscosity),
        ("shear_rate", shear_rate),
    ):
        positive(name, value)
    kind("model", model, AbstractModel)
    chain = model.chain(radius, beads)
    aspect_ratio = chain.length[0] / (2 * radius)  # the number of beads, if they touch
    rigidity = rigidity_from_bending_ratio(
        bending_ratio, radius, aspect_ratio, viscosity, shear_rate
    )
    scene = Scene(
        chain,
        viscosity,
        mobility=model.mobility,
        constraints=model.constraints(),
        forces=model.elasticity(chain, rigidity, intrinsic_curvature / chain.length[0]),
        flow=Shear(shear_rate),
    )
    span = 0.75 * float(jeffery_period(cox_aspect_ratio(beads), shear_rate))
    ts = np.linspace(0, span, 20 * int(np.ceil(span * shear_rate / 0.04 / 20)) + 1)
    return Case(scene, model.state(chain, np.full(beads, np.pi / 2)), ts)


def _radius(case: Case, solution: Solution) -> np.ndarray:
    chain = case.scene.chain
    radius = minimal_radius_of_curvature(solution.states.position, chain)
    return np.asarray(2 * radius / chain.length[0])


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    return {"min_radius": float(np.min(_radius(case, solution)))}


SHEAR = ReadyMade(
    "shear",
    "flexible fibre tumbling in shear: smallest radius of curvature",
    shear,
    {
        "beads": "number of beads",
        "bending_ratio": "bending ratio BR, eq. (54)",
        "intrinsic_curvature": "intrinsic curvature times length",
        "model": "gears, joint or spring",
    },
    _observables,
    {
        "min_radius": "smallest radius of curvature over half the length",
    },
    ("largest curvature, $L/2R$", lambda case, s: 1 / _radius(case, s)),
    quick="--beads 5 --bending-ratio 0.1 --model joint",
)
