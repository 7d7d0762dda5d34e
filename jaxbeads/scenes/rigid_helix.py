"""A rigid helix that turns about its axis."""

import numpy as np

from .._checks import positive
from ..assembly import Assembly
from ..body import Motor, helix
from ..locomotion import resistance
from ..solution import Solution
from .case import SAMPLES, AssemblyCase, ReadyMade, Value

__all__ = ["RIGID_HELIX", "rigid_helix"]

_X = (1.0, 0.0, 0.0)


def rigid_helix(
    wavelength: float = 9.811,
    length: float = 20.63,
    thickness: float = 0.063,
    *,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> AssemblyCase:
    """A rigid helix of touching beads that turns once about its axis, which is held (t = 1).

    Its resistance was measured by Rodenborn, Chen, Swinney, Liu & Zhang, PNAS 110 (2013) E338, for the
    defaults and other wavelengths; touching beads have the drag of a thinner rod, so that theirs is less
    by 3 to 15 %.

    **Arguments**: wavelength lambda, length L along the axis and thickness a of the filament (radius of
    its beads), over the helix radius R; R [length]; mu.

    **Raises** `ValueError` for numbers that are not positive.

    >>> from jaxbeads import scenes
    >>> case = scenes.rigid_helix(wavelength=6.509)
    >>> print(case.assembly.bodies[0].beads, case.ts[-1])
    227 1.0
    """
    for name, value in {"wavelength": wavelength, "length": length, "thickness": thickness}.items():
        positive(name, value)
    positive("radius", radius)
    turns = length / wavelength
    body = helix(radius, wavelength * radius, turns=turns, thickness=thickness * radius)
    motor = Motor(None, 0, axis=_X, rate=2 * np.pi)
    assembly = Assembly([body], viscosity, [motor])
    scales = {"drag": viscosity * radius}
    return AssemblyCase(assembly, assembly.drawn, np.linspace(0, 1, SAMPLES + 1), 1e-6, scales)


def _resistances(case: AssemblyCase, solution: Solution) -> dict[str, Value]:
    # The radius is that of the first bead, which is beside the origin of the axis.
    body, viscosity = case.assembly.bodies[0], float(case.assembly.viscosity)
    radius = float(np.linalg.norm(np.asarray(body.position)[0, 1:]))
    matrix = np.asarray(resistance(body, viscosity))
    unit = viscosity * radius
    return {
        "drag": float(matrix[0, 0]) / unit,
        "thrust": -float(matrix[0, 3]) / (unit * radius),
        "torque": float(matrix[3, 3]) / (unit * radius**2),
    }


RIGID_HELIX = ReadyMade(
    "rigid-helix",
    "a rigid helix that turns about its axis: drag, thrust, torque",
    rigid_helix,
    {
        "wavelength": "lambda over the helix radius R",
        "length": "L along the axis over R",
        "thickness": "radius of the filament's beads over R",
    },
    _resistances,
    {
        "drag": "force against a velocity along the axis over mu U R",
        "thrust": "force along the axis of a spin about it over mu Omega R^2",
        "torque": "torque against the spin over mu Omega R^3",
    },
    (
        "height of the first bead over $R$",
        lambda c, s: (
            np.asarray(s.states.position)[:, 0, 1] / np.asarray(s.states.position)[0, 0, 1]
        ),
    ),
    quick="--wavelength 5.0 --length 5.0 --thickness 0.2",
    co_moving=False,
)
