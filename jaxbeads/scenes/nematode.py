"""Undulating worms (section 3.5 of the paper): one, two side by side, and one near a wall."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import fail, finite, positive, whole
from ..actuation import TravellingWave
from ..chain import Chain, straight
from ..constraint import Gears
from ..domain import NoSlipWall
from ..force import Bending, Contact
from ..objectives import efficiency, swimming_speed
from ..scene import Scene
from ..solution import Solution
from .case import (
    SAMPLES,
    Case,
    ReadyMade,
    Value,
    distance_swum,
    last_period,
    until_periodic,
    worm_amplitude,
)

__all__ = [
    "NEMATODE",
    "NEMATODE_PAIR",
    "NEMATODE_WALL",
    "nematode",
    "nematode_pair",
    "nematode_wall",
]

_FREQUENCY = 1.0  # f; the unit of time
_STIFFNESS = 22.6
"""2 pi f mu L^4 / K_b of the nematode Caenorhabditis elegans (Majmudar et al., 2012)."""


def _worms(chain: Chain, viscosity: float, phase: Array | float) -> Bending:
    length = chain.length[0]
    rigidity = 2 * np.pi * _FREQUENCY * viscosity * length**4 / _STIFFNESS
    wave = TravellingWave(
        worm_amplitude(chain, 8.25), 1.5 * np.pi / length, _FREQUENCY, np.pi + jnp.asarray(phase)
    )
    return Bending(rigidity, wave)


def nematode(beads: int = 15, *, radius: float = 1.0, viscosity: float = 1.0) -> Case:
    """A Gears chain with the travelling wave of preferred curvature of a nematode,
    kappa_0 = -A(s) sin(k s - 2 pi f t), from straight until its swimming is periodic.

    A(s) = 8.25/L up to the middle and falls to 0 at the tail; k = 1.5 pi/L; 2 pi f mu L^4/K_b = 22.6;
    f = 1 (Majmudar et al., J. R. Soc. Interface 9 (2012) 1809). It swims against its wave.

    **Arguments**: number of beads (at least 4); a [length]; mu.

    **Raises** `ValueError` for too few beads.

    >>> from jaxbeads import scenes
    >>> case = scenes.nematode(beads=4)
    >>> print(case.ts[1], type(case.scene.forces[0]).__name__)  # forty times in a period
    0.025 Bending
    """
    whole("beads", beads, 4)
    chain = Chain(radius, beads)
    scene = Scene(chain, viscosity, constraints=[Gears()], forces=[_worms(chain, viscosity, 0.0)])
    tolerance = 1e-6 * float(chain.length[0])
    ts = np.linspace(0, 30 / _FREQUENCY, 30 * SAMPLES + 1)
    return Case(
        scene,
        straight(chain, [1.0, 0.0]),
        ts,
        tolerance=1e-7,  # a tenth of what counts as periodic
        until=until_periodic(tolerance),
        chunk=SAMPLES,
    )


@eqx.filter_jit
def _swimming(period: Solution, scene: Scene) -> tuple[Array, Array]:
    return swimming_speed(period, scene, _FREQUENCY), efficiency(period, scene)


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    speed, efficient = _swimming(last_period(solution), case.scene)
    return {"speed": float(speed), "efficiency": float(efficient)}


NEMATODE = ReadyMade(
    "nematode",
    "undulating worm: swimming speed and efficiency",
    nematode,
    {"beads": "number of beads"},
    _observables,
    {
        "speed": "swimming speed over f L",
        "efficiency": "power to drag the rigid straight worm at that speed, over the mean power",
    },
    ("distance swum over $L$", distance_swum),
    co_moving=False,
    quick="--beads 7",
)


def nematode_pair(
    beads: int = 15,
    distance: float = 1.0,
    antiphase: bool = False,
    *,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """Two nematodes side by side in the plane of their beat, from straight, for three periods.

    Beads of the two that come closer than a tenth of a radius repel each other (`Contact`); below a
    distance of about 0.45 L the worms touch.

    **Arguments**: number of beads of each; distance of the two axes over L; whether their waves are
    half a period apart; a [length]; mu.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.nematode_pair(beads=4, distance=1.0)
    >>> print(abs(case.state.position[4] - case.state.position[0]))  # one L apart
    [0. 8.]
    """
    whole("beads", beads, 4)
    positive("distance", distance)
    chain = Chain(radius, (beads, beads))
    length = float(chain.length[0])
    shift = np.where(chain.fibre_of_bead[1:-1] == 1, np.pi * antiphase, 0.0)
    bending = _worms(chain, viscosity, jnp.asarray(shift))
    contact = Contact(20 * bending.rigidity / length**2, 0.1 * radius, 0.1 * radius)
    scene = Scene(chain, viscosity, constraints=[Gears()], forces=[bending, contact])
    centres = [[0.0, -0.5 * distance * length], [0.0, 0.5 * distance * length]]
    ts = np.linspace(0, 3 / _FREQUENCY, 3 * SAMPLES + 1)
    return Case(scene, straight(chain, [1.0, 0.0], centres), ts)


def _advance(solution: Solution) -> float:
    """Displacement of the centre along x in the third period [length]."""
    centre = np.asarray(solution.states.position)[:, :, 0].mean(axis=1)
    return float(centre[3 * SAMPLES] - centre[2 * SAMPLES])


def _pair(case: Case, solution: Solution) -> dict[str, Value]:
    chain = case.scene.chain
    alone = nematode(
        chain.fibres[0], radius=float(chain.radius), viscosity=float(case.scene.viscosity)
    )
    ts = np.asarray(alone.ts)[: 3 * SAMPLES + 1]
    one = alone._replace(ts=ts, until=None).simulate(progress=False)
    return {"speed_ratio": _advance(solution) / _advance(one)}


NEMATODE_PAIR = ReadyMade(
    "nematode-pair",
    "two undulating worms side by side: their speed over that of one",
    nematode_pair,
    {
        "beads": "number of beads of each",
        "distance": "distance of the two over L",
        "antiphase": "waves half a period apart",
    },
    _pair,
    {
        "speed_ratio": "speed of the two over that of one",
    },
    ("distance swum over $L$", distance_swum),
    co_moving=False,
    quick="--beads 7 --distance 0.8 --antiphase",
)


_PERIODS = 10


def nematode_wall(
    beads: int = 15,
    height: float = 0.4,
    angle: float = 0.0,
    *,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """A nematode, as `nematode`, that swims along a no-slip wall, y = 0, towards +x, from straight for
    ten periods.

    The plane of its beat is normal to the wall. `Contact` keeps beads off the wall.

    **Arguments**: number of beads (at least 4); distance of the straight worm's centre from the wall
    over L; its heading towards the wall [rad]; a [length]; mu.

    **Raises** `ValueError` for a start behind the wall.

    >>> from jaxbeads import scenes
    >>> case = scenes.nematode_wall(beads=4, height=0.5)
    >>> print(case.scene.domain.height(case.state.position))  # L/2
    [4. 4. 4. 4.]
    """
    whole("beads", beads, 4)
    positive("height", height)
    finite("angle", angle)
    least = 0.5 * abs(np.sin(angle)) * (1 - 1 / beads) + 0.5 / beads
    if height < least:
        must = f"be at least {least:.3g}, where the worm touches the wall"
        fail("height", must, f"it is {height:g}")
    chain = Chain(radius, beads)
    length = float(chain.length[0])
    bending = _worms(chain, viscosity, 0.0)
    contact = Contact(20 * bending.rigidity / length**2, 0.1 * radius, 0.1 * radius)
    scene = Scene(
        chain,
        viscosity,
        constraints=[Gears()],
        forces=[bending, contact],
        domain=NoSlipWall([0.0, 0.0], [0.0, 1.0]),
    )
    heading = np.array([np.cos(angle), -np.sin(angle)])
    ts = np.linspace(0, _PERIODS / _FREQUENCY, _PERIODS * SAMPLES + 1)
    return Case(scene, straight(chain, -heading, [0.0, height * length]), ts)


def _above(case: Case, solution: Solution) -> np.ndarray:
    """Height of the centre over L."""
    centre = np.asarray(solution.states.position)[:, :, 1].mean(axis=1)
    return centre / float(case.scene.chain.length[0])


def _near_wall(case: Case, solution: Solution) -> dict[str, Value]:
    centre = np.asarray(solution.states.position).mean(axis=1) / float(case.scene.chain.length[0])
    way = np.diff(centre[::SAMPLES], axis=0)  # of each period
    heading = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    return {
        "speed": float(way[-1, 0]),
        "turn": float(heading[-1] - heading[1]),
        "height": float(centre[-1, 1]),
    }


NEMATODE_WALL = ReadyMade(
    "nematode-wall",
    "undulating worm near a wall: its speed along it, turn and height after ten periods",
    nematode_wall,
    {
        "beads": "number of beads",
        "height": "distance of its centre from the wall over L",
        "angle": "heading towards the wall [rad]",
    },
    _near_wall,
    {
        "speed": "speed along the wall in the tenth period, over f L",
        "turn": "direction of its way in the tenth period less that in the second, away from the wall "
        "positive [rad]",
        "height": "distance of its centre from the wall over L after ten periods",
    },
    ("distance from the wall $h/L$", _above),
    co_moving=False,
    quick="--beads 7 --height 0.6",
)
