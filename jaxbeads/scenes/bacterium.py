"""A bacterium: a head and a helix, with a motor between them."""

import numpy as np

from .._checks import positive
from ..assembly import Assembly
from ..body import Motor, helix, sphere
from ..locomotion import motion
from ..solution import Solution
from .case import SAMPLES, AssemblyCase, ReadyMade, Value

__all__ = ["BACTERIUM", "bacterium"]

_X = (1.0, 0.0, 0.0)
_TURNS = 3


def bacterium(
    head: float = 6.0,
    radius: float = 3.0,
    pitch: float = 14.0,
    turns: float = 3.0,
    *,
    thickness: float = 1.0,
    viscosity: float = 1.0,
    rate: float = 1.0,
) -> AssemblyCase:
    """A bacterium: a spherical head and a rigid helix of touching beads, which a motor spins against one
    another, for three turns of the helix in space, without force or torque on the whole.

    The helix begins at a distance a from the head's surface. Nothing changes in its frame, since the
    head is a sphere; so the path is a helix, along the axis of the helix' spin.

    **Arguments**: radius of the head, radius and pitch of the helix, over a, that of its beads; its
    number of turns; a [length]; mu; relative spin of the motor [1/time].

    **Raises** `ValueError` for numbers that are not positive.

    >>> from jaxbeads import scenes
    >>> case = scenes.bacterium()
    >>> print(case.assembly.beads, case.assembly.bodies[0].position, case.assembly.bodies[1].position[0])
    36 [[-7.  0.  0.]] [0. 3. 0.]
    """
    numbers = {"head": head, "radius": radius, "pitch": pitch, "turns": turns, "rate": rate}
    for name, value in numbers.items():
        positive(name, value)
    a = thickness
    positive("thickness", a)
    ball = sphere(head * a, [-(head + 1) * a, 0.0, 0.0])
    tail = helix(radius * a, pitch * a, turns=turns, thickness=a)
    assembly = Assembly([ball, tail], viscosity, [Motor(0, 1, axis=_X, rate=rate)])
    spin = np.linalg.norm(motion(0.0, assembly.drawn, assembly).spin[1])
    ts = np.linspace(0, _TURNS * 2 * np.pi / spin, _TURNS * SAMPLES + 1)
    scales = {"rate": rate, "pitch": pitch * a, "thickness": a}
    return AssemblyCase(assembly, assembly.drawn, ts, 1e-7, scales)


def _head(case: AssemblyCase, solution: Solution) -> np.ndarray:
    """Way of the head over its radius."""
    place = np.asarray(solution.states.position)[:, 0]
    return np.linalg.norm(place - place[0], axis=1) / float(case.assembly.bodies[0].radii[0])


def _swum(case: AssemblyCase, solution: Solution) -> dict[str, Value]:
    rate, pitch, a = (case.scales[name] for name in ("rate", "pitch", "thickness"))
    moved = motion(0.0, case.pose, case.assembly)
    axis = np.asarray(moved.spin[1] / np.linalg.norm(moved.spin[1]))
    place = np.asarray(solution.states.position)[:, 0]
    way = (place[-1] - place[0]) @ axis
    torque = np.asarray(moved.joint_torque)[0] @ np.array(_X)
    unit = float(case.assembly.viscosity) * a**3 * rate
    return {
        "speed": float(way) / (case.ts[-1] - case.ts[0]) / (pitch * rate / (2 * np.pi)),
        "head_spin": float(moved.spin[0] @ np.array(_X)) / rate,
        "motor_torque": float(torque) / unit,
    }


BACTERIUM = ReadyMade(
    "bacterium",
    "a head and a helix that a motor spins: speed, spin of the head, torque of the motor",
    bacterium,
    {
        "head": "radius of the head over a, that of the helix' beads",
        "radius": "radius of the helix over a",
        "pitch": "pitch of the helix over a",
        "turns": "number of turns of the helix",
    },
    _swum,
    {
        "speed": "along the mean path, over pitch times relative spin/(2 pi)",
        "head_spin": "spin of the head along the motor's axis over the relative spin",
        "motor_torque": "torque of the motor over mu a^3 times the relative spin",
    },
    ("way of the head over its radius", _head),
    quick="--head 3.0 --radius 2.0 --pitch 8.0 --turns 1.0",
    co_moving=False,
)
