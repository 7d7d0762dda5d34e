"""A bacterium: a head and a helix, with a motor between them."""

import jax
import numpy as np

from .. import quaternions
from .._checks import non_negative, positive
from ..assembly import Assembly
from ..body import Motor, fibre, helix, sphere
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
    flexible: float = 0.0,
    *,
    thickness: float = 1.0,
    viscosity: float = 1.0,
    rate: float = 1.0,
) -> AssemblyCase:
    """A bacterium: a spherical head and a helix of touching beads, which a motor spins against one
    another, for three turns of the helix in space, without force or torque on the whole.

    The helix begins at a distance a from the head's surface. Nothing changes in its frame, since the
    head is a sphere; so the path is a helix, along the axis of the helix' spin. A flexible helix
    (`body.fibre`, isotropic, K_t = K_b) is at rest as a rigid one is drawn and soon turns as a whole,
    in a shape that the load gives it; then speed and spin are those at the end.

    **Arguments**: radius of the head, radius and pitch of the helix, over a, that of its beads; its
    number of turns; M L/K_b, with M the torque of the motor of a rigid one, L the contour length of the
    helix and K_b its bending rigidity (0: rigid): the angle by which M would bend it, were it straight;
    a [length]; mu; relative spin of the motor [1/time].

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
    non_negative("flexible", flexible)
    ball = sphere(head * a, [-(head + 1) * a, 0.0, 0.0])
    tail = helix(radius * a, pitch * a, turns=turns, thickness=a)
    motor = Motor(0, 1, axis=_X, rate=rate)
    assembly = Assembly([ball, tail], viscosity, [motor])
    moved = motion(0.0, assembly.drawn, assembly)
    spin = np.linalg.norm(moved.spin[1])
    ts = np.linspace(0, _TURNS * 2 * np.pi / spin, _TURNS * SAMPLES + 1)
    scales = {"rate": rate, "pitch": pitch * a, "thickness": a}
    if flexible == 0:
        return AssemblyCase(assembly, assembly.drawn, ts, 1e-7, scales)
    torque = moved.joint_torque[0] @ np.array(_X)
    parts = fibre(tail, torque * 2 * a * tail.beads / flexible, first=1)
    assembly = Assembly([ball, *parts.bodies], viscosity, [motor, *parts.joints])
    return AssemblyCase(assembly, assembly.drawn, ts, 1e-6, scales, implicit=True)


def _head(case: AssemblyCase, solution: Solution) -> np.ndarray:
    """Way of the head over its radius."""
    place = np.asarray(solution.states.position)[:, 0]
    return np.linalg.norm(place - place[0], axis=1) / float(case.assembly.bodies[0].radii[0])


def _swum(case: AssemblyCase, solution: Solution) -> dict[str, Value]:
    rate, pitch, a = (case.scales[name] for name in ("rate", "pitch", "thickness"))
    pose = jax.tree.map(lambda x: x[-1], solution.poses)
    moved = motion(0.0, pose, case.assembly)
    motor = np.asarray(quaternions.matrix(pose.turn[0])) @ np.array(_X)
    axis = np.asarray(moved.spin[1] / np.linalg.norm(moved.spin[1]))
    # The shape is steady in the frame of its tail, so that one instant says all.
    arm = np.asarray(quaternions.matrix(pose.turn[0]) @ case.assembly.bodies[0].position[0])
    speed = float((moved.velocity[0] + np.cross(moved.spin[0], arm)) @ axis)
    torque = np.asarray(moved.joint_torque)[0] @ motor
    unit = float(case.assembly.viscosity) * a**3 * rate
    return {
        "speed": speed / (pitch * rate / (2 * np.pi)),
        "head_spin": float(moved.spin[0] @ motor) / rate,
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
        "flexible": "torque of the motor times contour length of the helix over its rigidity; 0: rigid",
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
