"""Cilia that stand on a no-slip wall and pump fluid along it: one, and a row of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import finite, positive, whole
from ..actuation import TwoStrokes
from ..chain import Chain, straight
from ..constraint import Gears, clamped
from ..dimensionless import rigidity_from_sperm_number
from ..domain import NoSlipWall
from ..force import Bending, Contact
from ..objectives import pumping_efficiency
from ..observables import pumping_rate, rigid_resistance
from ..scene import Scene
from ..solution import Solution
from .case import SAMPLES, Case, ReadyMade, Value, last_period, until_periodic

__all__ = ["CILIA_ROW", "CILIUM", "cilia_row", "cilium"]

_FREQUENCY = 1.0  # f; the unit of time
_MOST_PERIODS = 40
_ALONG, _UP = np.array([1.0, 0.0]), np.array([0.0, 1.0])
_GAP = 0.2
"""Distance of the held beads' surfaces from the wall over the radius, beyond the reach of contact."""


def _standing(
    chain: Chain,
    sperm_number: float,
    swing: float,
    phase: Array | float,
    places: np.ndarray,
    viscosity: float,
) -> Case:
    """Fibres that stand on the wall y = 0 at places along x [length], until their beat is periodic."""
    length = chain.length[0]
    alone = Chain(chain.radius, chain.fibres[0])
    flat = straight(alone, _ALONG).position
    friction = rigid_resistance(flat, alone, viscosity)[1, 1]
    omega = 2 * np.pi * _FREQUENCY
    rigidity = rigidity_from_sperm_number(sperm_number, length, omega, friction)
    reach = 0.1 * chain.radius
    firsts = np.cumsum((0, *chain.fibres[:-1]))
    scene = Scene(
        chain,
        viscosity,
        constraints=[Gears(), *(part for first in firsts for part in clamped(int(first)))],
        forces=[
            Bending(rigidity, TwoStrokes(swing, _FREQUENCY, phase)),
            Contact(20 * rigidity / length**2, reach, reach),
        ],
        domain=NoSlipWall(0.0 * _UP, _UP),
    )
    middle = float(0.5 * length + _GAP * chain.radius)
    centres = np.stack([places, np.full(len(places), middle)], axis=1)
    ts = np.linspace(0, _MOST_PERIODS / _FREQUENCY, _MOST_PERIODS * SAMPLES + 1)
    return Case(
        scene,
        straight(chain, _UP, centres),
        ts,
        tolerance=1e-6,  # a tenth of what counts as periodic
        until=until_periodic(1e-5 * float(length)),
        chunk=SAMPLES,
        scales={"sperm_number": sperm_number, "swing": swing},
    )


def cilium(
    beads: int = 15,
    sperm_number: float = 1.5,
    *,
    swing: float = 1.2,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """An elastic cilium that stands on a no-slip wall and beats in its plane, until the beat is
    periodic.

    A Gears chain, clamped upright on y = 0: its first bead, the direction of its first bond and the
    spin of that bead are held. The preferred curvature of `TwoStrokes` drives it: nearly straight and
    fast to the right, back slowly by a bend that runs to the tip, so that it pumps to the right, +x.
    `Contact` keeps beads off the wall and off one another (of fewer than 10 beads, the bend is so sharp
    that they meet); f = 1.

    **Arguments**: number of beads (at least 4); sperm number Sp, eq. (58), with zeta = 2 pi f and gamma
    the normal friction of the rigid straight chain far from walls: small values follow the preferred
    shape, large ones hardly move; swing of the preferred beat [rad]; a [length]; mu.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.cilium(beads=4)
    >>> print(case.scene.domain.direction, len(case.scene.constraints), len(case.scene.forces))
    [0. 1.] 4 2
    """
    whole("beads", beads, 4)
    positive("sperm_number", sperm_number)
    finite("swing", swing)
    chain = Chain(radius, beads)
    return _standing(chain, sperm_number, swing, 0.0, np.zeros(1), viscosity)


_rate = eqx.filter_jit(pumping_rate)  # of one instant: a program for runs of any length


def _pumped(case: Case, solution: Solution) -> np.ndarray:
    """Pumping rate to the right over f L^3, at each time."""
    scene, at = case.scene, (solution.ts, solution.states)
    moments = (jax.tree.map(lambda x, k=k: x[k], at) for k in range(len(solution.ts)))
    rates = np.array([float(_rate(t, state, scene, _ALONG)) for t, state in moments])
    return rates / (_FREQUENCY * float(scene.chain.length[0]) ** 3)


@eqx.filter_jit
def _efficiency(period: Solution, scene: Scene) -> Array:
    return pumping_efficiency(period, scene, _ALONG)


def _volume(case: Case, solution: Solution) -> float:
    """Volume pumped to the right in the last period over L^3."""
    return float(np.mean(_pumped(case, last_period(solution))[:-1]))


def _share_below(values: np.ndarray) -> float:
    """Share of the time in which values at equal times, joined by lines, are negative."""
    below = np.maximum(-values, 0.0)
    size = np.abs(values)
    both = size[1:] + size[:-1]
    return float(np.mean((below[1:] + below[:-1]) / np.where(both == 0, 1.0, both)))


def _one(case: Case, solution: Solution) -> dict[str, Value]:
    period = last_period(solution)
    rate = _pumped(case, period)
    mean = float(np.mean(rate[:-1]))
    return {
        "pumped": mean,
        "efficiency": float(_efficiency(period, case.scene)),
        "reversal": _share_below(rate * np.sign(mean)),
    }


CILIUM = ReadyMade(
    "cilium",
    "cilium on a wall that beats in two strokes: volume pumped, efficiency, backward flow",
    cilium,
    {
        "beads": "number of beads",
        "sperm_number": "sperm number Sp, eq. (58), of the beat's angular frequency",
    },
    _one,
    {
        "pumped": "volume of fluid driven along the wall in a period, over L^3; positive: to +x",
        "efficiency": "mu Q^2/(L^3 P), Q the mean pumping rate and P the mean power",
        "reversal": "share of the period in which the flow is against its mean",
    },
    ("pumping rate $Q/(f L^3)$", _pumped),
    co_moving=False,
    shown=last_period,
    quick="--beads 10",
)


def cilia_row(
    cilia: int = 3,
    beads: int = 10,
    spacing: float = 1.0,
    lag: float = 0.1,
    *,
    sperm_number: float = 1.5,
    swing: float = 1.2,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """A row of cilia, each as `cilium`, in the plane of their beat, until the beat is periodic.

    Each beats a part of the period after its neighbour to the right: for a small positive lag the wave
    runs to the left, against the effective stroke (antiplectic), for a negative one with it
    (symplectic). Antiplectic ones pump more. `Contact` keeps them off one another.

    **Arguments**: number of cilia; number of beads of each (at least 4); distance of neighbours over
    L; lag over the period; sperm number, swing, a and mu as for `cilium`.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.cilia_row(cilia=2, beads=4, spacing=1.5)
    >>> print(case.scene.chain.fibres, case.state.position[4] - case.state.position[0])  # 1.5 L apart
    (4, 4) [12.  0.]
    """
    whole("cilia", cilia, 1)
    whole("beads", beads, 4)
    positive("spacing", spacing)
    finite("lag", lag)
    positive("sperm_number", sperm_number)
    finite("swing", swing)
    chain = Chain(radius, (beads,) * cilia)
    phase = 2 * np.pi * lag * chain.fibre_of_bead[1:-1]
    places = spacing * float(chain.length[0]) * (np.arange(cilia) - 0.5 * (cilia - 1))
    return _standing(chain, sperm_number, swing, jnp.asarray(phase), places, viscosity)


def _row(case: Case, solution: Solution) -> dict[str, Value]:
    scene, scales = case.scene, case.scales
    alone = cilium(
        scene.chain.fibres[0],
        scales["sperm_number"],
        swing=scales["swing"],
        radius=float(scene.chain.radius),
        viscosity=float(scene.viscosity),
    )
    one = _volume(alone, alone.simulate(progress=False))
    return {"pumped": _volume(case, solution) / (len(scene.chain.fibres) * one)}


CILIA_ROW = ReadyMade(
    "cilia-row",
    "row of cilia on a wall: volume pumped by each over that of one alone",
    cilia_row,
    {
        "cilia": "number of cilia",
        "beads": "number of beads of each",
        "spacing": "distance of neighbours over L",
        "lag": "lag behind the neighbour to the right, over the period",
    },
    _row,
    {
        "pumped": "volume of fluid driven along the wall in a period per cilium, over that of one alone",
    },
    ("pumping rate of all $Q/(f L^3)$", _pumped),
    co_moving=False,
    shown=last_period,
    quick="--cilia 2 --beads 5",
)
