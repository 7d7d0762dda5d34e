"""Many fibres in space, first on a lattice: a cloud that settles, and a suspension in shear."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._checks import fail, positive, whole
from ..chain import Chain, straight
from ..constraint import Gears
from ..dimensionless import (
    cox_aspect_ratio,
    jeffery_period,
    rigidity_from_bending_ratio,
    rigidity_from_elasto_gravitational_number,
)
from ..flow import Shear
from ..force import Bending, Contact, Weight
from ..mobility import RPY
from ..objectives import mean_over_time
from ..observables import curvature, rigid_resistance, settling_velocity
from ..scene import Scene
from ..solution import Solution
from ..state import State
from ..stress import particle_stress
from .case import Case, ReadyMade, Value

__all__ = ["CLOUD", "SHEAR_SUSPENSION", "cloud", "shear_suspension"]

_TRIES = 1000
"""Directions that are tried for a fibre."""
_MOBILITY = RPY(far_error=1e-5)
"""What is measured has four digits."""


def _start(
    fibres: int, beads: int, spacing: float, seed: int, radius: float
) -> tuple[Chain, State]:
    """Straight fibres with random directions, their centres at sites of the smallest cube of a simple
    cubic lattice that has enough of them (those to be left empty are random, too). Surfaces of two
    fibres are at least a radius apart; `spacing` is in lengths.
    """
    whole("fibres", fibres, 1)
    whole("beads", beads, 3)
    positive("spacing", spacing)
    whole("seed", seed, 0)
    positive("radius", radius)
    chain = Chain(radius, (beads,) * fibres)
    length, random = 2 * radius * beads, np.random.default_rng(seed)
    side = next(n for n in range(1, fibres + 1) if n**3 >= fibres)
    sites = np.indices((side, side, side)).reshape(3, -1).T - 0.5 * (side - 1)
    centres = spacing * length * sites[np.sort(random.permutation(side**3)[:fibres])]
    along = radius * (2.0 * np.arange(beads) + 1 - beads)[:, None]
    least, placed, directions = 3 * radius, np.zeros((0, 3)), []
    for k, centre in enumerate(centres):
        # Off the centres of those that come later, too: there is no place for them elsewhere.
        others = np.concatenate([placed, centres[k + 1 :]]) - centre
        others = others[np.linalg.norm(others, axis=1) < 0.5 * length + least]
        for _ in range(_TRIES):
            direction = random.normal(size=3)
            direction = direction / np.linalg.norm(direction)
            own = along * direction
            apart = np.linalg.norm(own[:, None] - others[None], axis=2)
            if np.min(apart, initial=np.inf) >= least:
                break
        else:
            but = f"at {spacing:g} none of {_TRIES} directions keeps fibre {k} off the others"
            fail("spacing", "be larger", but)
        placed = np.concatenate([placed, centre + own])
        directions.append(direction)
    return chain, straight(chain, np.array(directions), centres)


def _friction(beads: int, radius: float, viscosity: float) -> float:
    """gamma_0, of one rigid straight fibre across its axis [force time/length]."""
    alone = Chain(radius, beads)
    flat = straight(alone, [1.0, 0.0]).position
    return float(rigid_resistance(flat, alone, viscosity)[1, 1])


def _by_fibre(case: Case, solution: Solution) -> np.ndarray:
    """Positions of the beads, `(times, fibres, beads, 3)`."""
    position = np.asarray(solution.states.position)
    return position.reshape(len(position), len(case.scene.chain.fibres), -1, 3)


def cloud(
    fibres: int = 8,
    beads: int = 10,
    elasto_gravitational: float = 1000.0,
    spacing: float = 1.0,
    *,
    seed: int = 0,
    radius: float = 1.0,
    viscosity: float = 1.0,
    weight: float = 1.0,
) -> Case:
    """A cloud of flexible fibres that settle along -y, from straight ones with random directions.

    Their centres start at the sites of a simple cubic lattice, in the smallest cube that holds them all
    (if there are more sites, random ones stay empty), their surfaces at least a radius apart. `Contact`
    keeps their beads apart, by the weight of a fibre where surfaces overlap by a tenth of the radius.
    The run takes the time in which one straight rigid fibre alone, horizontal, falls by two of its
    lengths, 2 L/V_s, V_s = F/gamma_0, with F its weight and gamma_0 its friction across its axis. A
    cloud falls faster: each fibre drags fluid along, in which the others fall, too.

    The results: `speed` is the mean velocity of all beads along -y at the end of the run, over V_s;
    `spread` and `spread_lateral` are root mean square distances of the fibres' centres (the means of
    their beads) from the mean of these, along y and across it, at the end over those at the start, or
    none where that is zero, as of a fibre alone; `smallest_gap` is the smallest distance of surfaces of
    beads of different fibres at any saved time, over a (negative: they overlap).

    **Arguments**: number of fibres; number of beads of each, of a Gears chain (at least 3);
    B = F L^2 / K_b, eq. (55), with F the whole weight of a fibre; distance of neighbouring sites over
    L; seed of the random directions; a [length]; mu; weight of a bead [force].

    **Raises** `ValueError` for numbers that are out of range, and for a spacing at which no place is
    found for a fibre.

    >>> from jaxbeads import scenes
    >>> case = scenes.cloud(fibres=8, beads=4, spacing=1.5)
    >>> centres = case.scene.chain.centres(case.state.position)
    >>> print(len(case.scene.chain.fibres), abs(centres[1] - centres[0]).round(6))  # 1.5 L apart
    8 [ 0.  0. 12.]
    """
    positive("elasto_gravitational", elasto_gravitational)
    positive("weight", weight)
    chain, state = _start(fibres, beads, spacing, seed, radius)
    length, force = float(chain.length[0]), weight * beads
    rigidity = rigidity_from_elasto_gravitational_number(elasto_gravitational, force, length)
    scene = Scene(
        chain,
        viscosity,
        _MOBILITY,
        constraints=[Gears()],
        forces=[
            Weight([0.0, -weight, 0.0]),
            Bending(rigidity),
            Contact(force, 0.1 * radius, 0.1 * radius),
        ],
    )
    speed = force / _friction(beads, radius, viscosity)
    return Case(scene, state, np.linspace(0, 2 * length / speed, 201), scales={"speed": speed})


def _sizes(case: Case, solution: Solution) -> np.ndarray:
    """Root mean square distances of the fibres' centres from their mean, along y and across it, at the
    start and at the end: `(2, 2)` [length].
    """
    centres = _by_fibre(case, solution)[[0, -1]].mean(axis=2)
    square = np.mean((centres - centres.mean(axis=1, keepdims=True)) ** 2, axis=1)
    return np.sqrt(np.stack([square[:, 1], square[:, 0] + square[:, 2]], axis=1))


def _smallest_gap(case: Case, solution: Solution) -> float | None:
    """Of beads of different fibres over all times, over a."""
    chain = case.scene.chain
    if len(chain.fibres) == 1:
        return None
    fibre, least = chain.fibre_of_bead, np.inf
    for position in np.asarray(solution.states.position):
        for k, first in enumerate(chain.first_beads[1:], start=1):
            own, others = position[fibre == k], position[:first]
            square = sum(
                (x[:, None] - y[None, :]) ** 2 for x, y in zip(own.T, others.T, strict=True)
            )
            least = min(least, float(np.min(square)))
    return float(np.sqrt(least) / float(chain.radius)) - 2


def _fall(case: Case, solution: Solution) -> np.ndarray:
    """Mean velocity of the beads along -y over V_s, at each time."""
    height = np.asarray(solution.states.position)[:, :, 1].mean(axis=1)
    return -np.gradient(height, np.asarray(solution.ts)) / case.scales["speed"]


_velocity = eqx.filter_jit(settling_velocity)


def _of_the_cloud(case: Case, solution: Solution) -> dict[str, Value]:
    velocity = _velocity(solution.ts[-1], solution.final, case.scene)
    start, end = _sizes(case, solution)
    # Centres at one height differ by rounding.
    there = start > 1e-6 * float(case.scene.chain.length[0])
    grown = [float(y / x) if some else None for x, y, some in zip(start, end, there, strict=True)]
    return {
        "speed": float(-velocity[1] / case.scales["speed"]),
        "spread": grown[0],
        "spread_lateral": grown[1],
        "smallest_gap": _smallest_gap(case, solution),
    }


CLOUD = ReadyMade(
    "cloud",
    "cloud of flexible fibres that settle: its speed, how it spreads, smallest gap",
    cloud,
    {
        "fibres": "number of fibres",
        "beads": "number of beads of each",
        "elasto_gravitational": "B = F L^2 / K_b, eq. (55), F the weight of a fibre",
        "spacing": "distance of neighbours on the lattice at the start over L",
    },
    _of_the_cloud,
    {
        "speed": "mean speed at the end over that of one rigid straight fibre alone, horizontal",
        "spread": "vertical size of the cloud at the end over that at the start (rms of centres)",
        "spread_lateral": "horizontal size of the cloud at the end over that at the start",
        "smallest_gap": "smallest distance of surfaces of different fibres over the run, over a",
    },
    ("mean speed $V/V_s$", _fall),
    quick="--fibres 3 --beads 4 --elasto-gravitational 100.0",
)


def shear_suspension(
    fibres: int = 8,
    beads: int = 10,
    bending_ratio: float = 0.04,
    spacing: float = 1.0,
    *,
    seed: int = 0,
    radius: float = 1.0,
    viscosity: float = 1.0,
    shear_rate: float = 1.0,
) -> Case:
    """Flexible fibres, as heavy as the fluid, in simple shear u_x = rate y: they start as those of
    `cloud`.

    The run takes one period of Jeffery's orbit of a rigid fibre, with r_e after Cox, eq. (51); in
    its second half, which is measured, a rigid one turns over once. `Contact` keeps their beads apart;
    its force where surfaces overlap by a tenth of the radius is gamma_0 rate L, with gamma_0 the
    friction of a fibre across its axis. The shear carries layers away from one another, by a spacing in
    a time of 1/rate: fibres of different ones meet early in the run, and later feel their own alone.
    Pictures show its first tenth.

    The results are means over the fibres and the second half of the run: `moments`, those of p, the
    direction from a fibre's first bead to its last, <p_x^2>, <p_y^2> and <p_x p_y> (1/3, 1/3 and 0
    where all directions are equal); `curvature`, the largest along a fibre times L; `normal_stress` and
    `shear_stress`, S_xx - S_yy and S_xy over mu rate L^3, with the stresslet S of a fibre as in
    `particle_stress`: times mu rate and the number of fibres in a volume L^3, they are the first normal
    stress difference and the shear stress that a dilute suspension has beyond its fluid.

    **Arguments**: number of fibres; number of beads of each, of a Gears chain (at least 3); bending
    ratio BR, eq. (54), as of `shear`; distance of neighbouring sites over L; seed of the random
    directions; a [length]; mu; shear rate.

    **Raises** `ValueError` for numbers that are out of range, and for a spacing at which no place is
    found for a fibre.

    >>> from jaxbeads import scenes
    >>> from jaxbeads.dimensionless import cox_aspect_ratio, jeffery_period
    >>> case = scenes.shear_suspension(fibres=2, beads=4)
    >>> print(f"{case.ts[-1] / jeffery_period(cox_aspect_ratio(4), 1.0):.4f}")
    1.0000
    """
    for name, value in (
        ("bending_ratio", bending_ratio),
        ("viscosity", viscosity),
        ("shear_rate", shear_rate),
    ):
        positive(name, value)
    chain, state = _start(fibres, beads, spacing, seed, radius)
    length = float(chain.length[0])
    rigidity = rigidity_from_bending_ratio(bending_ratio, radius, beads, viscosity, shear_rate)
    push = _friction(beads, radius, viscosity) * shear_rate * length
    scene = Scene(
        chain,
        viscosity,
        _MOBILITY,
        constraints=[Gears()],
        forces=[Bending(rigidity), Contact(push, 0.1 * radius, 0.1 * radius)],
        flow=Shear(shear_rate),
    )
    period = float(jeffery_period(cox_aspect_ratio(beads), shear_rate))
    stress = viscosity * shear_rate * length**3
    return Case(scene, state, np.linspace(0, period, 401), scales={"stress": stress})


def _moments(case: Case, solution: Solution) -> np.ndarray:
    """Means over the fibres of p_x^2, p_y^2 and p_x p_y, `(times, 3)`."""
    position = _by_fibre(case, solution)
    ends = position[:, :, -1] - position[:, :, 0]
    x, y, _ = np.moveaxis(ends / np.linalg.norm(ends, axis=2, keepdims=True), 2, 0)
    return np.stack([x * x, y * y, x * y], axis=2).mean(axis=1)


def _first_tenth(solution: Solution) -> Solution:
    return _part(solution, slice(len(solution.ts) // 10 + 1))


def _part(solution: Solution, times: slice) -> Solution:
    ts, states = jax.tree.map(lambda x: x[times], (solution.ts, solution.states))
    return Solution(ts, states, solution.steps, solution.code)


def _second_half(solution: Solution) -> Solution:
    return _part(solution, slice(len(solution.ts) // 2, None))


def _of_the_suspension(case: Case, solution: Solution) -> dict[str, Value]:
    chain, late = case.scene.chain, _second_half(solution)
    bent = jnp.abs(curvature(late.states.position, chain))
    bent = np.pad(np.asarray(bent), ((0, 0), (1, 1))).reshape(len(bent), len(chain.fibres), -1)
    largest = bent.max(axis=2).mean(axis=1) * float(chain.length[0])
    columns, ts = np.column_stack([_moments(case, late), largest]), np.asarray(late.ts)
    means = np.trapezoid(columns, ts, axis=0) / (ts[-1] - ts[0])
    stresslet = np.asarray(mean_over_time(particle_stress, late, case.scene)).mean(axis=0)
    stresslet = stresslet / case.scales["stress"]
    return {
        "moments": means[:3].tolist(),
        "curvature": float(means[3]),
        "normal_stress": float(stresslet[0, 0] - stresslet[1, 1]),
        "shear_stress": float(stresslet[0, 1]),
    }


SHEAR_SUSPENSION = ReadyMade(
    "shear-suspension",
    "flexible fibres in shear: their directions, curvature, and the stress that they add",
    shear_suspension,
    {
        "fibres": "number of fibres",
        "beads": "number of beads of each",
        "bending_ratio": "bending ratio BR, eq. (54)",
        "spacing": "distance of neighbours on the lattice at the start over L",
    },
    _of_the_suspension,
    {
        "moments": "means of p_x^2, p_y^2 and p_x p_y, p from a fibre's first bead to its last",
        "curvature": "mean of the fibres' largest curvature times L",
        "normal_stress": "first normal stress difference, of a fibre, over mu rate L^3",
        "shear_stress": "shear stress, of a fibre, over mu rate L^3",
    },
    (r"mean $p_x p_y$", lambda case, s: _moments(case, s)[:, 2]),
    shown=_first_tenth,
    filmed=_first_tenth,
    quick="--fibres 2 --beads 4 --spacing 0.8",
)
