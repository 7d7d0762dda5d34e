"""One list for each kind of thing: a new member is one entry here and then meets every contract."""

import dataclasses
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxbeads import AB3, ESDIRK, Chain, Scene, State, dynamics, from_directors, from_tangents
from jaxbeads.actuation import AbstractCurvature, FourierCurvature, TravellingWave, TwoStrokes
from jaxbeads.constraint import (
    EqualSpins,
    FrozenJoints,
    Gears,
    Inextensible,
    Joint,
    PrescribedDirection,
    PrescribedLengths,
    PrescribedPosition,
    PrescribedSpin,
)
from jaxbeads.flow import Extension, LinearFlow, OscillatingShear, Poiseuille, Shear, VelocityField
from jaxbeads.force import (
    Bending,
    BendingEnergy,
    Contact,
    DrivingMoment,
    ElasticRod,
    EndTorque,
    Follower,
    ForceField,
    MagneticFibre,
    ParamagneticBeads,
    ParamagneticFibre,
    Potential,
    SineRuleCurvature,
    Spring,
    Weight,
)
from jaxbeads.magnetism import HarmonicField, MagneticField, UniformField
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.solver import AbstractSolver, Diffrax, Rosenbrock

MOBILITIES = [
    FreeDraining(),
    RPY(),
    RPY(strained=False),
    FreeDraining(dense=False),
    RPY(dense=False),
]

# Sets of constraints that stand together, the one that is meant last.
CONSTRAINTS = [
    (Gears(),),
    (Joint(),),
    (Inextensible(),),
    (Gears(), FrozenJoints()),
    (Gears(), EqualSpins()),
    (Gears(), PrescribedPosition(bead=3)),
    (Gears(), PrescribedSpin(bead=-1)),
    (Gears(), PrescribedDirection(bond=1)),
    (PrescribedLengths(lambda t: 2 + 0.1 * jnp.sin(t + jnp.arange(8.0))),),
]


def flows(dim):
    matrix = np.array([[0.1, 0.5, 0.2], [-0.2, -0.1, 0.1], [0.3, 0.0, 0.0]])
    return [
        Shear(0.7),
        OscillatingShear(0.7, 2.0, 0.3),
        Extension(0.4),
        LinearFlow(matrix[:dim, :dim]),
        Poiseuille(1.3, 8.0),
        VelocityField(lambda t, x: jnp.sin(0.1 * x[::-1] + t)),
    ]


def turning_field(dim):
    vectors = np.array([[0.9, 0.2, 0.1], [-0.3, 1.1, 0.4], [0.5, 0.0, 0.2]])[:, :dim]
    return HarmonicField(1.5, *vectors)


def forces(dim):
    """Each acts on a chain of any number of beads."""
    solid = [ElasticRod(30.0, 20.0, 45.0, 0.05, TravellingWave(0.2, 0.4, 1.5, 0.3), 0.07)]
    solid += [EndTorque(0.6), EndTorque([0.3, -0.6, 0.9], end=0)]
    return (solid if dim == 3 else []) + [
        Weight(np.array([0.1, -0.4, 0.2])[:dim]),
        Bending(30.0, 0.02),
        Bending(30.0, 0.02, SineRuleCurvature()),
        BendingEnergy(30.0, 0.02),
        BendingEnergy(30.0, 0.02, SineRuleCurvature()),
        Bending(30.0, TravellingWave(0.2, 0.4, 1.5, 0.3)),
        Bending(30.0, FourierCurvature([[0.1, 0.2], [0.0, -0.1]], [[0.0, 0.1], [0.0, 0.3]], 0.7)),
        Bending(30.0, TwoStrokes(0.4, 0.3, 0.2)),
        DrivingMoment(TravellingWave(2.0, 0.4, 1.5, 0.3)),
        Spring(20.0),
        Contact(5.0, 2.5, 1.0),
        Follower(0.7),
        Follower(0.7, end=0),
        ForceField(lambda t, x: -0.1 * x),
        Potential(lambda t, x: 0.05 * jnp.sum(x**2) * (1 + t)),
        MagneticFibre(0.6, turning_field(dim), permeability=5.0),
        MagneticFibre(0.6, lambda t, x: jnp.sin(0.1 * x[::-1] + t)),
        ParamagneticFibre(0.8, turning_field(dim)),
        ParamagneticBeads(0.9, UniformField(np.array([1.0, 0.4, -0.3])[:dim]), permeability=5.0),
    ]


FLOWS = flows(2)
FORCES = forces(2)

# Solver, order.
SOLVERS = [
    (AB3(), 3),
    (Diffrax(diffrax.Euler()), 1),
    (Diffrax(diffrax.Heun()), 2),
    (Diffrax(diffrax.Bosh3()), 3),
    (Rosenbrock(), 4),
    (ESDIRK(), 4),
]


def name(case):
    """A readable test id; of a set, that of the one that is meant."""
    if isinstance(case, tuple):
        case = case[0] if isinstance(case[0], AbstractSolver) else case[-1]
    if isinstance(case, AbstractSolver):
        return case.name
    rule = (
        f"-{type(case.discrete_curvature).__name__}" if hasattr(case, "discrete_curvature") else ""
    )
    free = "-free" if getattr(case, "dense", None) is False else ""
    return type(case).__name__ + rule + free


def bent(chain: Chain, dim: int = 2, seed: int = 0, centre=None) -> State:
    """A smoothly and irregularly bent chain of touching beads."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, chain.beads - 1)
    waves = [rng.normal() * np.sin((k + 1) * np.pi * s + rng.uniform(0, 6)) for k in range(3)]
    angle = 0.6 * sum(waves)
    e = [np.cos(angle), np.sin(angle)]
    if dim == 3:
        rise = 0.5 * np.sin(2 * np.pi * s + rng.uniform(0, 6))
        e = [e[0] * np.cos(rise), e[1] * np.cos(rise), np.sin(rise)]
    return State(from_tangents(chain, np.stack(e, axis=1), centre))


def jointed(chain: Chain, dim: int = 2, seed: int = 0, centre=None) -> State:
    """A bent chain of the Joint Model: directors between the tangents of `bent`."""
    position = bent(chain, dim, seed).position
    step = jnp.diff(position, axis=0)
    directors = jnp.pad(step, ((0, 1), (0, 0))) + jnp.pad(step, ((1, 0), (0, 0)))
    return from_directors(chain, directors, centre)


def scene(chain: Chain, dim: int = 2, flow=True, **options) -> Scene:
    """Gears fibre(s) with weight, bending and shear."""
    weight = np.array([0.1, -0.4, 0.2])[:dim]
    options.setdefault("forces", [Weight(weight), Bending(30.0)])
    options.setdefault("constraints", [Gears()])
    return Scene(chain, 1.3, flow=Shear(0.3) if flow else None, **options)


@eqx.filter_jit
def _instant(t, state, scene):
    return dynamics.motion(t, state, scene), dynamics.constraint_residual(t, state, scene)


def instant(t, state, scene):
    """Motion and residual of one instant by one program: what they have in common is compiled once."""
    return _instant(jnp.asarray(t), state, scene)


def spatial(state: State) -> State:
    """A planar state in three dimensions."""
    return State(jnp.pad(state.position, ((0, 0), (0, 1))))


# Length, time and force in the dimension of every number; a class whose numbers are not here is refused.
NUMBER, LENGTH, TIME, FORCE = (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)
RATE, CURVATURE, VELOCITY, MOMENT = (0, -1, 0), (-1, 0, 0), (1, -1, 0), (1, 0, 1)
_BENDING = {"rigidity": (2, 0, 1), "intrinsic_curvature": CURVATURE}
_FIELD, _MAGNET = (-1, 0, 0.5), (2, 0, 0.5)  # in Gaussian units: B^2 is an energy per volume
DIMENSIONS = {
    "State": {"position": LENGTH, "director": NUMBER, "frame": NUMBER},
    "Chain": {"radius": LENGTH, "gap": LENGTH},
    "Scene": {"viscosity": (-2, 1, 1)},
    "Weight": {"force": FORCE},
    "Bending": _BENDING,
    "BendingEnergy": _BENDING,
    "JointBending": _BENDING,
    "JointRepulsion": dict(viscous=FORCE, elastic=NUMBER, roughness=NUMBER, decay=NUMBER),
    "DrivingMoment": {"moment": MOMENT},
    "Spring": {"stiffness": (-1, 0, 1)},
    "Contact": {"strength": FORCE, "roughness": LENGTH, "decay": LENGTH},
    "ElasticRod": dict(
        rigidity=(2, 0, 1),
        twist_rigidity=(2, 0, 1),
        second_rigidity=(2, 0, 1),
        intrinsic_curvature=CURVATURE,
        second_curvature=CURVATURE,
        intrinsic_twist=CURVATURE,
    ),
    "EndTorque": {"torque": MOMENT},
    "Follower": {"force": FORCE},
    "ForceField": {"function": FORCE},
    "Potential": {"function": MOMENT},
    "MagneticFibre": {"moment": _MAGNET, "permeability": NUMBER},
    "MagneticBeads": {"moment": _MAGNET, "permeability": NUMBER},
    "ParamagneticFibre": {"susceptibility": (3, 0, 0)},
    "ParamagneticBeads": {"susceptibility": (3, 0, 0), "permeability": NUMBER},
    "UniformField": {"law": _FIELD},
    "HarmonicField": {
        "angular_frequency": RATE,
        "cosine": _FIELD,
        "sine": _FIELD,
        "constant": _FIELD,
    },
    "MagneticField": {"function": _FIELD},
    "VelocityField": {"function": VELOCITY},
    "Shear": {"rate": RATE},
    "OscillatingShear": {"rate": RATE, "angular_frequency": RATE, "phase": NUMBER},
    "Extension": {"rate": RATE},
    "LinearFlow": {"matrix": RATE},
    "Poiseuille": {"speed": VELOCITY, "half_width": LENGTH},
    "PrescribedPosition": {"law": LENGTH},
    "PrescribedSpin": {"law": RATE},
    "PrescribedRoll": {"law": RATE},
    "PrescribedDirection": {"law": NUMBER},
    "PrescribedLengths": {"law": LENGTH},
    "NoSlipWall": {"point": LENGTH, "normal": NUMBER},
}
# What the functions among them are given.
_GIVEN = {
    "function": (TIME, LENGTH),
    "law": (TIME,),
    "intrinsic_curvature": (TIME, LENGTH, LENGTH),
    "second_curvature": (TIME, LENGTH, LENGTH),
    "moment": (TIME, LENGTH, LENGTH),
}


def _scaled(function, value, *rest):
    given, x = rest[: len(rest) // 2], rest[len(rest) // 2 :]
    return function(*(y / unit for y, unit in zip(x, given, strict=True))) * value


def in_units(thing, units):
    """A scene, a state or a part of one in other units: the numbers of one length, time and force."""

    def factor(dimension):
        return float(np.prod(np.asarray(units, float) ** dimension))

    def scaled(value, dimension, given):
        if value is None:
            return None
        if not callable(value):
            return value * factor(dimension)
        scales = [jnp.asarray(factor(d)) for d in (dimension, *given)]  # one program for all units
        return Partial(_scaled, value, *scales)

    if isinstance(thing, tuple):
        return tuple(in_units(x, units) for x in thing)
    if not isinstance(thing, eqx.Module):
        return thing
    known = DIMENSIONS.get(type(thing).__name__, {})
    changes = {}
    for field in dataclasses.fields(thing):
        value = getattr(thing, field.name)
        if field.name in known:
            changes[field.name] = scaled(value, known[field.name], _GIVEN.get(field.name))
        elif isinstance(value, (tuple, eqx.Module)):
            changes[field.name] = in_units(value, units)
        elif eqx.is_array(value):
            raise KeyError(f"The dimension of {type(thing).__name__}.{field.name} is not known.")
    return dataclasses.replace(thing, **changes) if changes else thing


class Turn(NamedTuple):
    """How space is turned (or mirrored), x -> Q x + shift."""

    q: Array
    shift: Array

    @property
    def sign(self):
        """Of what turns like a spin."""
        return jnp.sign(jnp.linalg.det(self.q))


def vector(value, turn):
    return value @ turn.q.T


def place(value, turn):
    return value @ turn.q.T + jnp.broadcast_to(turn.shift, value.shape)


def axial(value, turn):
    """Vectors at each place; what has no direction is as it was."""
    return turn.sign * value @ turn.q.T if getattr(value, "ndim", 0) == 2 else value


# Functions hold what they turn and by how much as leaves, so that one program serves all turns.


def _law(sign, turn, law, t):
    return sign * (turn.q @ law(t))


def _before(x, turn):
    return (x - jnp.broadcast_to(turn.shift, x.shape)) @ turn.q


def _vectors(turn, function, t, x):
    return function(t, _before(x, turn)) @ turn.q.T


def _numbers(turn, function, t, x):
    return function(t, _before(x, turn))


def law(value, turn):
    return None if value is None else Partial(_law, 1.0, turn, value)


def axial_law(value, turn):
    return None if value is None else Partial(_law, turn.sign, turn, value)


def flow(value, turn):
    return None if value is None else VelocityField(Partial(_vectors, turn, value.velocity))


# How the numbers of a class turn; those that are not here do not.
TURNS = {
    "State": {"position": place, "director": vector, "frame": vector},
    "Scene": {"flow": flow},
    "NoSlipWall": {"point": place, "normal": vector},
    "Weight": {"force": vector},
    "EndTorque": {"torque": lambda value, turn: vector(value, turn) if value.ndim else value},
    "Bending": {"intrinsic_curvature": axial},
    "ForceField": {"function": lambda f, turn: Partial(_vectors, turn, f)},
    "Potential": {"function": lambda f, turn: Partial(_numbers, turn, f)},
    # Moments along fibres turn as they do, so fields as well.
    "UniformField": {"law": lambda b, turn: law(b, turn) if callable(b) else vector(b, turn)},
    "HarmonicField": {"cosine": vector, "sine": vector, "constant": vector},
    "MagneticField": {"function": lambda f, turn: Partial(_vectors, turn, f)},
    "PrescribedPosition": {"law": law},
    "PrescribedSpin": {"law": axial_law},
    "PrescribedDirection": {"law": law},
}


def turned(thing, turn):
    """A scene, a state or a part of one, turned in space."""
    if isinstance(thing, tuple):
        return tuple(turned(x, turn) for x in thing)
    rules = TURNS.get(type(thing).__name__, {})
    changes = {}
    for field in dataclasses.fields(thing) if isinstance(thing, eqx.Module) else ():
        value = getattr(thing, field.name)
        if value is not None and field.name in rules:
            changes[field.name] = rules[field.name](value, turn)
        elif isinstance(value, (tuple, eqx.Module)):
            changes[field.name] = turned(value, turn)
    return dataclasses.replace(thing, **changes) if changes else thing


class Upright(AbstractCurvature):
    """A planar curvature as vectors along z."""

    planar: AbstractCurvature

    def __call__(self, t, arclength, length):
        return jnp.pad(self.planar(t, arclength, length)[:, None], ((0, 0), (2, 0)))


def _bending(f):
    if callable(f.intrinsic_curvature):
        return Bending(f.rigidity, Upright(f.intrinsic_curvature), f.discrete_curvature)
    vectors = f.intrinsic_curvature * jnp.array([[0.0, 0.0, 1.0]])
    return Bending(f.rigidity, jnp.tile(vectors, (5, 1)), f.discrete_curvature)


def _magnet(f):
    def padded(b):
        if isinstance(b, MagneticField):
            return MagneticField(lambda t, x: jnp.append(b.function(t, x[:2]), 0.0))
        vectors = {k: jnp.pad(v, (0, 1)) for k, v in vars(b).items() if v.ndim}
        return dataclasses.replace(b, **vectors)

    return dataclasses.replace(f, field=padded(f.field))


# What has another form in space than in the plane, on a chain of seven beads.
SPATIAL = {
    "Weight": lambda f: Weight(jnp.pad(f.force, (0, 1))),
    "Bending": _bending,
    "DrivingMoment": lambda f: DrivingMoment(Upright(f.moment)),
    "BendingEnergy": lambda f: (
        None if jnp.any(f.intrinsic_curvature) else f
    ),  # it has no sign there
    **dict.fromkeys(["MagneticFibre", "ParamagneticFibre", "ParamagneticBeads"], _magnet),
    "LinearFlow": lambda f: LinearFlow(jnp.pad(f.matrix, ((0, 1), (0, 1)))),
    "VelocityField": lambda f: VelocityField(lambda t, x: jnp.append(f.function(t, x[:2]), 0.0)),
}


def in_space(term):
    """A planar force or flow in three dimensions; `None` if it has no form there."""
    return SPATIAL.get(type(term).__name__, lambda same: same)(term)
