"""Magnetic fibres: a rod in a rotating field, a swimmer with a paramagnetic tail."""

import numpy as np
from jaxtyping import Array

from .._checks import non_negative, positive, whole
from ..chain import Chain, straight
from ..constraint import EqualSpins, Gears
from ..dimensionless import rigidity_from_sperm_number
from ..force import Bending, MagneticFibre, ParamagneticFibre
from ..magnetism import HarmonicField
from ..observables import orientation, rigid_resistance
from ..scene import Scene
from ..solution import Solution
from .case import SAMPLES, Case, ReadyMade, Value, last_period, until_periodic

__all__ = ["MAGNETIC_ROD", "MAGNETIC_SWIMMER", "magnetic_rod", "magnetic_swimmer"]

_SLIPS = 3
_MOST_PERIODS = 100


def _friction(chain: Chain, viscosity: float) -> Array:
    """Of a rigid straight planar rod: along, across, turning about its centre."""
    flat = straight(chain, [1.0, 0.0]).position
    return rigid_resistance(flat, chain, viscosity).diagonal()


def magnetic_rod(
    beads: int = 10, frequency: float = 1.5, *, radius: float = 1.0, viscosity: float = 1.0
) -> Case:
    """A rigid rod with a permanent moment m along it, in a field B that rotates in its plane; it starts
    along the field.

    The rod turns by m B sin(omega t - theta)/gamma_r. It follows the field up to the step-out frequency
    omega_so = m B/gamma_r; above, it falls behind by whole turns, and turns at
    omega - sqrt(omega^2 - omega_so^2) on average. The unit of time is 1/omega_so. A run lasts until the
    lag is steady, or for three periods of the slip, 2 pi/sqrt(omega^2 - omega_so^2).

    **Arguments**: number of beads (at least 2); omega over omega_so; a [length]; mu.

    **Raises** `ValueError` for too few beads and numbers that are not positive.

    >>> import jax.numpy as jnp
    >>> from jaxbeads import dynamics, scenes
    >>> case = scenes.magnetic_rod(beads=3, frequency=2.0)
    >>> across = dynamics.motion(jnp.pi / 4, case.state, case.scene)  # a quarter turn later
    >>> print(across.spin.round(12).ravel())
    [1. 1. 1.]
    """
    whole("beads", beads, 2)
    positive("frequency", frequency)
    chain = Chain(radius, beads)
    moment = _friction(chain, viscosity)[2] / beads
    field = HarmonicField(frequency, [1.0, 0.0], [0.0, 1.0])
    scene = Scene(
        chain,
        viscosity,
        constraints=[Gears(), EqualSpins()],
        forces=[MagneticFibre(moment, field)],
    )
    slip, period = np.sqrt(abs(frequency**2 - 1)), 2 * np.pi / frequency
    if frequency > 1:
        span = _SLIPS * 2 * np.pi / slip
        saves = (
            _SLIPS * SAMPLES * int(np.ceil(span / (_SLIPS * SAMPLES * 0.5)))
        )  # it turns by 1 at most
    else:
        # Lags decay like exp(-slip t), or slower where there is none.
        periods = 1 + int(np.ceil(20 / max(slip, 0.02) / period))
        span, saves = periods * period, periods * SAMPLES
    return Case(scene, straight(chain, [1.0, 0.0]), np.linspace(0, span, saves + 1), 20, 1e-8)


def _angle(solution: Solution) -> np.ndarray:
    return np.unwrap(np.asarray(orientation(solution.states.position)))


def _frequency(case: Case) -> float:
    (field,) = (
        f.field for f in case.scene.forces if isinstance(f, (MagneticFibre, ParamagneticFibre))
    )
    return float(field.angular_frequency) if isinstance(field, HarmonicField) else 1.0


def _rotation(case: Case, solution: Solution) -> dict[str, Value]:
    omega = _frequency(case)
    part = solution if omega > 1 else last_period(solution)
    angle, ts = _angle(part), np.asarray(part.ts)
    return {"mean_rotation": float((angle[-1] - angle[0]) / (omega * (ts[-1] - ts[0])))}


def _lag(case: Case, solution: Solution) -> np.ndarray:
    return _frequency(case) * np.asarray(solution.ts) - _angle(solution)


MAGNETIC_ROD = ReadyMade(
    "magnetic-rod",
    "rigid magnetic rod in a rotating field: its mean rate of turning",
    magnetic_rod,
    {"beads": "number of beads", "frequency": "frequency of the field over step-out"},
    _rotation,
    {
        "mean_rotation": "mean rate of turning over that of the field, over whole periods of the slip",
    },
    ("lag behind the field [rad]", _lag),
    co_moving=False,
    quick="--beads 3 --frequency 1.5",
)


def magnetic_swimmer(
    beads: int = 10,
    sperm_number: float = 2.0,
    field: float = 0.5,
    *,
    head: float = 3.0,
    magnetic_number: float = 10.0,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """A flexible paramagnetic tail with a spherical head, after Dreyfus et al., Nature 437 (2005) 862,
    in the field (B_0, B_1 cos(omega t)), until the beat is periodic. The unit of time is its period.

    The tail is a Gears chain of beads along x, with the energy -chi (e . B)^2/2 of each bond; the head,
    its first bead, is not magnetic. Its length is L = 2 a beads. Three numbers make the beat: the sperm
    number Sp = L (omega gamma/(L K_b))^(1/4), with gamma the friction of a straight tail across itself;
    chi/(2a) B_0^2 L^2/K_b, of magnetic over elastic torques; and B_1/B_0. It swims with its free end
    first. The speed vanishes without a head, by symmetry, and for small Sp, where shapes follow the
    field and return as they came; it is even in B_1, and as B_1^2 where that is small.

    **Arguments**: number of beads of the tail (at least 3); Sp; B_1/B_0; radius of the head over a (0
    for none); chi/(2a) B_0^2 L^2/K_b; a [length]; mu.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.magnetic_swimmer(beads=4, head=2.0)
    >>> print(case.scene.chain.radius, (case.scene.forces[1].susceptibility > 0))
    [2. 1. 1. 1. 1.] [False  True  True  True]
    """
    whole("beads", beads, 3)
    positive("sperm_number", sperm_number)
    positive("field", field)
    non_negative("head", head)
    positive("magnetic_number", magnetic_number)
    tail, omega = Chain(radius, beads), 2 * np.pi
    length = tail.length[0]
    across = _friction(tail, viscosity)[1]
    rigidity = rigidity_from_sperm_number(sperm_number, length, omega, across)
    susceptibility = np.full(beads - 1, 1.0) * magnetic_number * rigidity * 2 * radius / length**2
    chain = tail
    if head:
        chain = Chain(radius * np.array([head, *np.ones(beads)]), beads + 1)
        susceptibility = np.array([0.0, *susceptibility])
    magnet = HarmonicField(omega, [0.0, field], constant=[1.0, 0.0])
    scene = Scene(
        chain,
        viscosity,
        constraints=[Gears()],
        forces=[Bending(rigidity), ParamagneticFibre(susceptibility, magnet)],
    )
    bend = min(field, 1.0)
    return Case(
        scene,
        straight(chain, [1.0, 0.0]),
        np.linspace(0, _MOST_PERIODS, _MOST_PERIODS * SAMPLES + 1),
        tolerance=1e-6 * bend,
        until=until_periodic(1e-5 * bend * float(length)),
        chunk=SAMPLES,
        scales={"length": float(length)},
    )


def _swum(case: Case, solution: Solution) -> np.ndarray:
    """Way of the mean of all beads since the start over L."""
    centre = np.asarray(solution.states.position).mean(axis=1)
    return (centre - centre[0]) / case.scales["length"]


def _swimming(case: Case, solution: Solution) -> dict[str, Value]:
    period = last_period(solution)
    moved = _swum(case, period)[-1]
    position = np.asarray(period.states.position)
    along = (position[:, -1] - position[:, 0]).mean(axis=0)
    speed = float(np.linalg.norm(moved))
    towards = float(moved @ along / np.linalg.norm(along)) / speed if speed else None
    return {"speed": speed, "direction": towards}


MAGNETIC_SWIMMER = ReadyMade(
    "magnetic-swimmer",
    "flexible paramagnetic tail with a head in an oscillating field: speed and direction",
    magnetic_swimmer,
    {
        "beads": "number of beads of the tail",
        "sperm_number": "sperm number of the tail",
        "field": "amplitude of the oscillating field over the constant one across it",
    },
    _swimming,
    {
        "speed": "displacement in a period over the tail's length",
        "direction": "cosine between displacement and tail: 1: free end first, -1: head first",
    },
    ("distance swum over $L$", lambda case, s: np.linalg.norm(_swum(case, s), axis=1)),
    co_moving=False,
    shown=last_period,
    quick="--beads 5 --sperm-number 2.0 --field 0.5",
)
