"""Bad input: one clear sentence that names the argument, before anything is traced."""

import importlib
import re
import shutil

import diffrax
import h5py
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

from jaxbeads import (
    AB3,
    Chain,
    Diffrax,
    Rosenbrock,
    Scene,
    State,
    check,
    from_directors,
    from_tangents,
    load,
    observables,
    periodic_state,
    resume,
    rollout,
    scenes,
    simulate,
    straight,
    with_frames,
)
from jaxbeads.__main__ import main
from jaxbeads.actuation import (
    FourierCurvature,
    HelicalBeat,
    PlanarBeat,
    TravellingWave,
)
from jaxbeads.constraint import (
    FrozenJoints,
    Gears,
    Joint,
    PrescribedDirection,
    PrescribedLengths,
    PrescribedPosition,
    PrescribedRoll,
    PrescribedSpin,
    clamped,
)
from jaxbeads.dynamics import applied_load
from jaxbeads.flow import Extension, LinearFlow, OscillatingShear, Poiseuille, Shear
from jaxbeads.force import (
    Bending,
    BendingEnergy,
    Contact,
    ElasticRod,
    EndTorque,
    Follower,
    ForceField,
    JointBending,
    JointRepulsion,
    MagneticBeads,
    MagneticFibre,
    ParamagneticBeads,
    ParamagneticFibre,
    SineRuleCurvature,
    Spring,
    Weight,
)
from jaxbeads.magnetism import HarmonicField
from jaxbeads.mobility import RPY
from jaxbeads.solver import substeps_for

NAN = float("nan")

CHAIN = Chain(1.0, 5)
START = straight(CHAIN, [1.0, 0.0])
SPATIAL = straight(CHAIN, [1.0, 0.0, 0.0])
TIMES = np.linspace(0.0, 0.8, 5)
PID = diffrax.PIDController(rtol=0.0, atol=1e-6)


def model(chain=CHAIN, viscosity=1.0, **terms):
    terms = {"constraints": [Gears()], "forces": [Bending(10.0)], "flow": Shear(1.0)} | terms
    return Scene(chain, viscosity, **terms)


def run(state=START, ts=TIMES, scene=None, **options):
    return simulate(scene or model(), state, ts, progress=False, **options)


def run_force(*forces, state=START, **options):
    return run(state, scene=model(forces=forces), **options)


def bent_by(rigidity):
    return model(forces=[Bending(rigidity)])


def paper_step(scene):
    return rollout(scene, START, TIMES, solver=AB3())


def single(tree):
    return jax.tree.map(lambda x: x.astype(jnp.float32), tree)


def sentence(error):
    """The one form that a refusal has."""
    text = str(error)
    assert re.fullmatch(r"Argument `[\w.-]+` must [^\n]+, but [^\n]+[^.\s]\.", text), text
    assert not re.search(r"[.!?] [A-Z]", text), text  # one sentence, not two
    assert not re.search(r"Traceback|Traced<|Tracer|0x[0-9a-f]|object at|\berrno\b", text), text
    return text


@pytest.fixture(autouse=True)
def as_for_users(monkeypatch):
    # Users have run-time type checks off; with them on, some of these calls do not get as far.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def never(*_, **__):
    raise AssertionError("the input was not refused in time")


@pytest.fixture
def unrun(monkeypatch):
    """Nothing may be advanced."""
    # By name: the attribute `jaxbeads.simulate` is the function.
    monkeypatch.setattr(importlib.import_module("jaxbeads.run"), "_stretch", never)


@pytest.fixture
def untraced(unrun, monkeypatch):
    """Nothing may be compiled, and the dynamics may not even be traced."""
    for name in ("evaluation", "solved"):
        monkeypatch.setattr(importlib.import_module("jaxbeads.instant"), name, never)
    for module, name in (("simulate", "_init"), ("run", "_diagnostics")):
        monkeypatch.setattr(importlib.import_module(f"jaxbeads.{module}"), name, never)


# What is wrong: the call, and the part of the message that has to say so.
CHAINS = {
    "negative radius": (
        lambda: Chain(-1.0, 5),
        "`radius` must be positive, but its smallest value",
    ),
    "zero radius": (lambda: Chain(0, 5), "`radius` must be positive"),
    "NaN radius": (lambda: Chain(NAN, 5), "`radius` must be finite, but it holds nan"),
    "infinite radius": (lambda: Chain(np.inf, 5), "`radius` must be finite, but it holds inf"),
    "too few radii": (
        lambda: Chain([1.0, 1.0], 5),
        "`radius` must have shape () or (5,), but it has shape (2,)",
    ),
    "one radius negative": (
        lambda: Chain([1, 1, -2, 1, 1], 5),
        "`radius` must be positive, but its smallest value is -2",
    ),
    "one radius NaN": (lambda: Chain([1, NAN, 1], 3), "it holds nan at index [1]"),
    "no fibres": (lambda: Chain(1.0, ()), "`fibres` must name at least one fibre"),
    "fibre of 0 beads": (lambda: Chain(1.0, (3, 0)), "`fibres` must be at least 1, but it is 0"),
    "fibre of 5.0 beads": (
        lambda: Chain(1.0, 5.0),
        "`fibres` must be a whole number, but it is 5.0",
    ),
    "fibres None": (lambda: Chain(1.0, None), "`fibres` must be a whole number, but it is None"),
    "zero direction": (lambda: straight(CHAIN, [0, 0]), "`direction` must not be zero"),
    "zero direction of one fibre": (
        lambda: straight(Chain(1.0, (2, 3)), [[1, 0], [0, 0]], [[0, 0], [0, 9]]),
        "`direction` must not be zero, but it is zero at index [1]",
    ),
    "NaN direction": (lambda: straight(CHAIN, [1, NAN]), "`direction` must be finite"),
    "direction in 4-D": (
        lambda: straight(CHAIN, [1, 0, 0, 0]),
        "`direction` must have shape (2,) or (3,) or (1, 2) or (1, 3), but it has shape (4,)",
    ),
    "too few tangents": (
        lambda: from_tangents(CHAIN, np.ones((3, 2))),
        "`tangents` must have shape (4, 2 or 3), but it has shape (3, 2)",
    ),
    "zero tangent": (
        lambda: from_tangents(CHAIN, [[1, 0], [1, 0], [0, 0], [1, 0]]),
        "`tangents` must not be zero, but it is zero at index [2]",
    ),
    "NaN tangent": (lambda: from_tangents(Chain(1.0, 2), [[1, NAN]]), "`tangents` must be finite"),
    "spatial centre in the plane": (
        lambda: straight(CHAIN, [1, 0], [0, 0, 0]),
        "`centre` must have shape (2,) or (1, 2), but it has shape (3,)",
    ),
    "NaN centre": (lambda: straight(CHAIN, [1, 0], [0, NAN]), "`centre` must be finite"),
}

STATES = {
    "position in 4-D": (
        lambda: State(np.zeros((5, 4))),
        "`position` must have shape (beads, 2) or (beads, 3), but it has shape (5, 4)",
    ),
    "position in one row": (lambda: State(np.zeros(5)), "`position` must have shape (beads, 2)"),
    "no beads": (lambda: State(np.zeros((0, 2))), "`position` must have shape (beads, 2)"),
    "NaN position": (
        lambda: State([[0, 1], [0, NAN]]),
        "`position` must be finite, but it holds nan at index [1, 1]",
    ),
    "too few directors": (
        lambda: State(np.zeros((5, 2)), np.ones((4, 2))),
        "`director` must have the position's shape (5, 2), but it has (4, 2)",
    ),
    "NaN director": (lambda: State([[0, 1]], [[NAN, 1]]), "`director` must be finite"),
    "directors that nothing turns": (
        lambda: run(
            State(START.position, jnp.ones((5, 2))),
            scene=Scene(CHAIN, 1.0, forces=[Weight([0, 1])]),
            substeps=1,
        ),
        "`state` must hold no directors, but no term of the scene turns beads",
    ),
    "another number of beads": (
        lambda: run(straight(Chain(1.0, 4), [1, 0])),
        "`state` must hold the chain's 5 beads, but it holds 4",
    ),
    "an array as state": (
        lambda: run(START.position),
        "`state` must be a State object, but it is an ArrayImpl",
    ),
    "overlap": (
        lambda: run(
            straight(Chain(1.0, (2, 3)), [1, 0], [[0, 0], [3, 1.5]]),
            scene=model(Chain(1.0, (2, 3))),
            overlap=False,
        ),
        "`state` must hold no overlapping beads in this scene, but beads 1 and 2 overlap by 0.5",
    ),
    "float32": (
        lambda: run(State(np.asarray(START.position, np.float32))),
        "`state` must be in float64, but it is in float32: call jax.config.update(",
    ),
    "float32 in a float64 scene": (
        lambda: run(single(START), single_precision=True),
        "`scene` must be in float32 as the state is, but it holds numbers in float64",
    ),
}

TERMS = {
    "zero viscosity": (lambda: model(viscosity=0), "`viscosity` must be positive"),
    "negative viscosity": (
        lambda: model(viscosity=-0.5),
        "`viscosity` must be positive, but its smallest value is -0.5",
    ),
    "NaN viscosity": (lambda: model(viscosity=NAN), "`viscosity` must be finite"),
    "two viscosities": (
        lambda: model(viscosity=[1.0, 2.0]),
        "`viscosity` must have shape (), but it has shape (2,)",
    ),
    "force as constraint": (
        lambda: model(constraints=[Weight([0, 1])]),
        "`constraints` must hold AbstractConstraint objects, but it holds a Weight",
    ),
    "constraint as force": (
        lambda: model(forces=[Gears()]),
        "`forces` must hold AbstractForce objects, but it holds a Gears",
    ),
    "a class as constraint": (
        lambda: model(constraints=[Gears]),
        "`constraints` must hold AbstractConstraint objects, but it holds the class Gears itself",
    ),
    "a constraint without a list": (
        lambda: model(constraints=Gears()),
        "`constraints` must be a list of AbstractConstraint objects, but it is a Gears",
    ),
    "force as flow": (
        lambda: model(flow=Weight([0, 1])),
        "`flow` must be an AbstractFlow object, but it is a Weight",
    ),
    "a class as mobility": (
        lambda: model(mobility=RPY),
        "`mobility` must be an AbstractMobility object, but it is the class RPY itself",
    ),
    "a number as chain": (
        lambda: Scene(5, 1.0),
        "`chain` must be a Chain object, but it is an int",
    ),
    "negative rigidity": (lambda: Bending(-1.0), "`rigidity` must not be negative"),
    "NaN rigidity": (lambda: BendingEnergy(NAN), "`rigidity` must be finite"),
    "matrix of rigidities": (
        lambda: Bending(np.ones((2, 2))),
        "`rigidity` must be one number or one for each joint, but it has shape (2, 2)",
    ),
    "too many rigidities": (
        lambda: run_force(Bending(np.ones(4))),
        "`Bending.rigidity` must have shape () or (3,), but it has shape (4,)",
    ),
    "too many rigidities of the energy": (
        lambda: run_force(BendingEnergy(np.ones(4))),
        "`BendingEnergy.rigidity` must have shape () or (3,), but it has shape (4,)",
    ),
    "NaN intrinsic curvature": (
        lambda: Bending(1.0, [0, NAN, 0]),
        "`intrinsic_curvature` must be finite, but it holds nan at index [1]",
    ),
    "curvature vectors in the plane": (
        lambda: run_force(Bending(1.0, np.ones((3, 3)))),
        "`Bending.intrinsic_curvature` must have shape () or (3,), but it has shape (3, 3)",
    ),
    "curvature vectors of the energy": (
        lambda: BendingEnergy(1.0, np.ones((3, 3))),
        "`intrinsic_curvature` must be one number or one for each joint",
    ),
    "spatial weight in the plane": (
        lambda: run_force(Weight([0, 0, 1]), Bending(1.0)),
        "`Weight.force` must have shape (2,) or (5, 2), but it has shape (3,)",
    ),
    "planar weight in space": (
        lambda: run_force(Weight([0, 1]), Bending(1.0), state=SPATIAL),
        "`Weight.force` must have shape (3,) or (5, 3), but it has shape (2,)",
    ),
    "weight without direction": (
        lambda: Weight(1.0),
        "`force` must have shape (dim,) or (beads, dim), but it has shape ()",
    ),
    "NaN weight": (
        lambda: Weight([0, NAN]),
        "`force` must be finite, but it holds nan at index [1]",
    ),
    "oblong LinearFlow": (
        lambda: LinearFlow(np.ones((2, 3))),
        "`matrix` must have shape (2, 2) or (3, 3), but it has shape (2, 3)",
    ),
    "spatial LinearFlow in the plane": (
        lambda: run(scene=model(flow=LinearFlow(np.zeros((3, 3))))),
        "`LinearFlow.matrix` must have shape (2, 2), but it has shape (3, 3)",
    ),
    "LinearFlow with a trace": (
        lambda: rollout(model(flow=LinearFlow(np.eye(3))), SPATIAL, TIMES),
        "`LinearFlow.matrix` must have no trace (incompressible), but it is 3",
    ),
    "plates that touch": (lambda: Poiseuille(1.0, 0.0), "`half_width` must be positive"),
    "NaN shear rate": (lambda: Shear(NAN), "`rate` must be finite"),
    "infinite extension": (lambda: Extension(np.inf), "`rate` must be finite, but it holds inf"),
    "NaN frequency": (lambda: OscillatingShear(1.0, NAN), "`angular_frequency` must be finite"),
    "frozen joints in space": (
        lambda: run(SPATIAL, scene=model(constraints=[Gears(), FrozenJoints()])),
        "`state` must be planar for FrozenJoints, but it is three-dimensional",
    ),
}

DRIVES = {
    "negative gap": (lambda: Chain(1.0, 5, -0.1), "`gap` must not be negative"),
    "a gap for each bead": (
        lambda: Chain(1.0, 5, np.ones(5)),
        "`gap` must have shape (), but it has shape (5,)",
    ),
    "zero director": (
        lambda: from_directors(CHAIN, [[1, 0], [1, 0], [0, 0], [1, 0], [1, 0]]),
        "`directors` must not be zero, but it is zero at index [2]",
    ),
    "too few directors for a chain": (
        lambda: from_directors(CHAIN, np.ones((4, 2))),
        "`directors` must have shape (5, 2) or (5, 3), but it has shape (4, 2)",
    ),
    "joints without directors": (
        lambda: run(scene=model(constraints=[Joint()], forces=[]), substeps=1),
        "`state` must hold directors for Joint, but it holds none",
    ),
    "joint bending without directors": (
        lambda: run_force(JointBending(1.0)),
        "`state` must hold directors for JointBending, but it holds none",
    ),
    "bending of beads that joints hold": (
        lambda: run(from_directors(CHAIN, np.ones((5, 2))), scene=model(constraints=[Joint()])),
        "`scene.forces` must bend a chain of Joint with JointBending, but it holds Bending",
    ),
    "joint bending without joints": (
        lambda: run(
            from_directors(CHAIN, np.ones((5, 2))), scene=model(forces=[JointBending(1.0)])
        ),
        "`scene.constraints` must hold Joint beside JointBending, but it does not",
    ),
    "ends that were not unpacked": (
        lambda: model(constraints=[Gears(), clamped()]),
        "it holds a tuple (unpack it with *, as *clamped())",
    ),
    "joints apart": (
        lambda: run(
            State(START.position, jnp.tile(jnp.array([[0.6, 0.8]]), (5, 1))),
            scene=model(constraints=[Joint()], forces=[]),
            substeps=1,
        ),
        "`state` must hold neighbours at touching distance, but beads 0 and 1 are off it by",
    ),
    "too many rigidities of joints": (
        lambda: run(
            from_directors(CHAIN, np.ones((5, 2))),
            scene=model(constraints=[Joint()], forces=[JointBending(np.ones(3))]),
        ),
        "`JointBending.rigidity` must have shape () or (4,), but it has shape (3,)",
    ),
    "negative repulsion": (lambda: JointRepulsion(-1.0), "`viscous` must not be negative"),
    "smooth surfaces": (lambda: Contact(1.0, 0.0, 0.1), "`roughness` must be positive"),
    "negative contact": (lambda: Contact(-1.0, 0.1, 0.1), "`strength` must not be negative"),
    "negative spring": (lambda: Spring(-1.0), "`stiffness` must not be negative"),
    "too many springs": (
        lambda: run_force(Spring(np.ones(5))),
        "`Spring.stiffness` must have shape () or (4,), but it has shape (5,)",
    ),
    "follower in the middle": (lambda: Follower(1.0, end=2), "`end` must be -1 (last bead) or 0"),
    "a moment for each bond": (
        lambda: run_force(MagneticFibre(np.ones(4), [1.0, 0.0])),
        "`MagneticFibre.moment` must have shape () or (5,), but it has shape (4,)",
    ),
    "NaN moment": (lambda: MagneticFibre(NAN, [1.0, 0.0]), "`moment` must be finite"),
    "a field in space for a planar fibre": (
        lambda: run_force(ParamagneticFibre(1.0, [1.0, 0.0, 0.0])),
        "`UniformField.law` must have shape (2,), but it has shape (3,)",
    ),
    "a field of another size": (
        lambda: run_force(MagneticFibre(1.0, lambda t, x: x[:1])),
        "`MagneticField.function` must have shape (2,), but it has shape (1,)",
    ),
    "a sine of another size": (
        lambda: HarmonicField(1.0, [1.0, 0.0], [0.0, 0.0, 1.0]),
        "`sine` must have shape (2,), but it has shape (3,)",
    ),
    "negative permeability": (
        lambda: ParamagneticBeads(1.0, [1.0, 0.0], -1.0),
        "`permeability` must not be negative",
    ),
    "moments along directors without directors": (
        lambda: run_force(MagneticBeads(1.0, [1.0, 0.0])),
        "`state` must hold directors for MagneticBeads, but it holds none",
    ),
    "a tail of two beads": (
        lambda: scenes.magnetic_swimmer(beads=2),
        "`beads` must be at least 3",
    ),
    "NaN follower": (lambda: Follower(NAN), "`force` must be finite"),
    "a bead that is not there": (
        lambda: run(scene=model(constraints=[Gears(), PrescribedPosition(bead=5)])),
        "`PrescribedPosition.bead` must lie between -5 and 4, but it is 5",
    ),
    "a bond that is not there": (
        lambda: run(scene=model(constraints=[Gears(), PrescribedDirection(bond=4)])),
        "`PrescribedDirection.bond` must lie between -4 and 3, but it is 4",
    ),
    "a rod in the plane": (
        lambda: run_force(ElasticRod(1.0, 1.0)),
        "`state` must be in space for ElasticRod, but it is planar",
    ),
    "twist rigidity below zero": (
        lambda: ElasticRod(1.0, -1.0),
        "`twist_rigidity` must not be negative",
    ),
    "a twist for each joint": (
        lambda: run_force(ElasticRod(1.0, 1.0, intrinsic_twist=np.ones(3)), state=SPATIAL),
        "`ElasticRod.intrinsic_twist` must have shape () or (4,), but it has shape (3,)",
    ),
    "frames along the fibre": (
        lambda: run_force(state=State(SPATIAL.position, frame=jnp.tile(jnp.eye(3)[:1], (5, 1)))),
        "`state.frame` must hold unit vectors normal to the fibre, but",
    ),
    "frames without spins": (
        lambda: run(with_frames(SPATIAL, CHAIN), scene=model(constraints=[], forces=[])),
        "`state` must hold no frames, but no term of the scene turns beads",
    ),
    "a normal along the fibre": (
        lambda: with_frames(SPATIAL, CHAIN, [1.0, 0.0, 0.0]),
        "`normal` must lie across the fibre, but it points along it",
    ),
    "planar frames": (lambda: with_frames(START, CHAIN), "`state` must be one state in space"),
    "roll in the plane": (
        lambda: run(scene=model(constraints=[Gears(), PrescribedRoll()])),
        "`state` must be in space for PrescribedRoll",
    ),
    "two rolls of one": (
        lambda: run(SPATIAL, scene=model(constraints=[Gears(), PrescribedRoll([1.0, 2.0])])),
        "`PrescribedRoll.law` must have shape ()",
    ),
    "a torque in the middle": (lambda: EndTorque(1.0, end=2), "`end` must be -1 (last bead) or 0"),
    "two torques": (lambda: EndTorque([1.0, 2.0]), "`torque` must have shape () or (3,)"),
    "half a bead": (lambda: PrescribedSpin(bead=0.5), "`bead` must be a whole number"),
    "a spatial law in the plane": (
        lambda: run(scene=model(constraints=[Gears(), PrescribedDirection(HelicalBeat(0.1, 1.0))])),
        "`PrescribedDirection.law` must have shape (2,), but it has shape (3,)",
    ),
    "a law for another number of arms": (
        lambda: run(scene=model(constraints=[PrescribedLengths(lambda t: jnp.ones(3))])),
        "`PrescribedLengths.law` must have shape (4,), but it has shape (3,)",
    ),
    "a law of two arguments": (
        lambda: run(scene=model(constraints=[Gears(), PrescribedPosition(lambda t, x: x)])),
        "`PrescribedPosition.law` must be a function that can be called with a time, but it raises",
    ),
    "separation of touching spheres": (
        lambda: scenes.three_sphere(2.5, 0.5),
        "`separation` must be so large that the spheres stay apart",
    ),
    "no model": (lambda: scenes.settling(5, model="joint"), "`model` must be an AbstractModel"),
    "no sperm number": (lambda: scenes.planar_beating(5, 0.0), "`sperm_number` must be positive"),
    "helix of 3 beads": (lambda: scenes.spiral(3), "`beads` must be at least 4, but it is 3"),
    "worms at no distance": (lambda: scenes.nematode_pair(8, 0.0), "`distance` must be positive"),
    "NaN follower force": (lambda: scenes.follower_force(8, NAN), "`force` must be finite"),
    "a number as law": (lambda: PrescribedPosition(1.0), "`law` must be a function"),
    "waves of one amplitude too many": (
        lambda: run_force(Bending(1.0, TravellingWave(np.ones(4), 1.0, 1.0))),
        "`Bending.intrinsic_curvature` must be a function that can be called with 3 joints, but",
    ),
    "vectors in the plane": (
        lambda: run_force(Bending(1.0, lambda t, s, length: jnp.ones((3, 3)))),
        "`Bending.intrinsic_curvature` must have shape () or (3,), but it has shape (3, 3)",
    ),
    "two curvatures of bending": (
        lambda: run_force(Bending(1.0, lambda t, s, length: jnp.ones((3, 2))), state=SPATIAL),
        "`Bending.intrinsic_curvature` must have shape () or (3,) or (3, 3), but it has shape (3, 2)",
    ),
    "two curvatures in one": (
        lambda: run_force(
            ElasticRod(1.0, 1.0, None, lambda t, s, length: jnp.ones((3, 2))), state=SPATIAL
        ),
        "`ElasticRod.intrinsic_curvature` must have shape () or (3,), but it has shape (3, 2)",
    ),
    "matrix of amplitudes": (
        lambda: TravellingWave(np.ones((2, 2)), 1.0, 1.0),
        "`amplitude` must be one number or one for each joint",
    ),
    "NaN wave": (lambda: TravellingWave(1.0, NAN, 1.0), "`wavenumber` must be finite"),
    "unequal series": (
        lambda: FourierCurvature(np.ones((2, 3)), np.ones((2, 2)), 1.0),
        "`sine` must have shape (2, 3), but it has shape (2, 2)",
    ),
    "series in one row": (
        lambda: FourierCurvature(np.ones(3), np.ones(3), 1.0),
        "`cosine` must have shape (modes, harmonics), but it has shape (3,)",
    ),
    "NaN beat": (lambda: PlanarBeat(0.1, NAN), "`angular_frequency` must be finite"),
}

STEPS = {
    "unsorted times": (
        lambda: run(ts=[0, 0.2, 0.1]),
        "`ts` must increase from entry to entry, but entry 2 (0.1) does not exceed entry 1 (0.2)",
    ),
    "a time twice": (
        lambda: rollout(model(), START, [0, 0.1, 0.1]),
        "`ts` must increase from entry to entry, but entry 2 (0.1) does not exceed entry 1 (0.1)",
    ),
    "one time": (lambda: run(ts=[0.0]), "`ts` must be a sequence of at least two times"),
    "a number as times": (lambda: run(ts=1.0), "`ts` must be a sequence of at least two times"),
    "NaN times": (
        lambda: run(ts=[0, NAN, 1]),
        "`ts` must be finite, but it holds nan at index [1]",
    ),
    "uneven times": (
        lambda: run(solver=AB3(), ts=[0, 0.1, 0.3]),
        "`ts` must be evenly spaced for AB3, whose steps are equal, but its intervals range from 0.1",
    ),
    "no substeps": (lambda: run(substeps=0), "`substeps` must be at least 1, but it is 0"),
    "2.5 substeps": (lambda: run(substeps=2.5), "`substeps` must be a whole number, but it is 2.5"),
    "True substeps": (
        lambda: run(substeps=True),
        "`substeps` must be a whole number, but it is True",
    ),
    "controller and substeps": (
        lambda: Diffrax(diffrax.Tsit5(), controller=PID, substeps=3),
        "`substeps` must be None when a controller chooses the steps, but it is 3",
    ),
    "controller for AB3": (
        lambda: AB3(controller=PID),
        "`controller` must be None for a solver that does not estimate its error, but AB3 does not",
    ),
    "tolerance and substeps": (
        lambda: run(tolerance=1e-5, substeps=3),
        "`tolerance` must be None when substeps is given, but it is 1e-05",
    ),
    "tolerance and controller": (
        lambda: Rosenbrock(tolerance=1e-5, controller=PID),
        "`tolerance` must be None when a controller is given, but it is 1e-05",
    ),
    "both in a solver": (
        lambda: Rosenbrock(tolerance=1e-5, substeps=3),
        "`tolerance` must be None when substeps is given, but it is 1e-05",
    ),
    "tolerance beside a solver": (
        lambda: run(solver=Rosenbrock(), tolerance=1e-5),
        "`tolerance` must be None beside a solver, whose own option it is",
    ),
    "substeps beside a solver": (
        lambda: rollout(model(), START, TIMES, solver=AB3(), substeps=3),
        "`substeps` must be None beside a solver, whose own option it is",
    ),
    "a tolerance for each bead": (
        lambda: Rosenbrock(tolerance=[1e-5, 1e-6]),
        "`tolerance` must have shape (), but it has shape (2,)",
    ),
    "tolerance for AB3": (
        lambda: AB3(tolerance=1e-5),
        "`tolerance` must be None for a solver that does not estimate its error, but AB3 does not",
    ),
    "negative tolerance": (lambda: run(tolerance=-1e-5), "`tolerance` must be positive"),
    "tolerance below rounding": (
        lambda: run(tolerance=1e-15),
        "`tolerance` must lie between 2e-14 (rounding) and 0.1, as a fraction of the fibre's length",
    ),
    "name as solver": (
        lambda: run(solver="AB3"),
        "`solver` must be a solver object, as AB3() or diffrax.Tsit5(), but it is 'AB3'",
    ),
    "class as solver": (
        lambda: run(solver=AB3),
        "`solver` must be a solver object, as AB3() or diffrax.Tsit5(), but it is the class AB3",
    ),
    "AB3 wrapped": (
        lambda: Diffrax(AB3()),
        "`wrapped` must be a diffrax solver object, as diffrax.Tsit5(), but it is an AB3",
    ),
    "a period by tolerance": (
        lambda: periodic_state(model(), START, 1.0, solver=Rosenbrock(tolerance=1e-5)),
        "`solver` must take equal steps in a period",
    ),
    "no max_steps": (
        lambda: Rosenbrock(max_steps=0),
        "`max_steps` must be at least 1, but it is 0",
    ),
    "nothing to take a step from": (
        lambda: run_force(Weight([0, 1]), solver=AB3()),
        "`substeps` must be given, but it is None and the scene has no bending rigidity",
    ),
    "substeps for a traced rigidity": (
        lambda: jax.eval_shape(lambda k: substeps_for(bent_by(k), TIMES), 1.0),
        "`scene` must hold known numbers, but it is traced: call `substeps_for` outside, with the",
    ),
    "substeps for traced times": (
        lambda: jax.eval_shape(lambda ts: substeps_for(model(), ts), TIMES),
        "`ts` must hold known numbers, but it is traced: call `substeps_for` outside",
    ),
    "substeps from a traced scene": (
        lambda: jax.eval_shape(lambda mu: paper_step(model(viscosity=mu)), 1.0),
        "`substeps` must be given when the scene or the times are traced, but it is None",
    ),
}

SCENES = {
    "shear of 2 beads": (lambda: scenes.shear(2), "`beads` must be at least 3, but it is 2"),
    "negative bending ratio": (
        lambda: scenes.shear(5, -0.1),
        "`bending_ratio` must be positive, but its smallest value is -0.1",
    ),
    "jeffery of 1 bead": (lambda: scenes.jeffery(1), "`beads` must be at least 2, but it is 1"),
    "jeffery of 2.5 beads": (lambda: scenes.jeffery(2.5), "`beads` must be a whole number"),
    "settling of 2 beads": (lambda: scenes.settling(2), "`beads` must be at least 3, but it is 2"),
    "settling with B = 0": (
        lambda: scenes.settling(5, 0.0),
        "`elasto_gravitational` must be positive",
    ),
    "relaxation mode too large": (
        lambda: scenes.relaxation(5, 4),
        "`mode` must be at most 3 (beads - 2), but it is 4",
    ),
    "relaxation mode 0": (
        lambda: scenes.relaxation(5, 0),
        "`mode` must be at least 1, but it is 0",
    ),
}

OPTIONS = {
    "chunk of 0": (lambda: run(chunk=0), "`chunk` must be at least 1, but it is 0"),
    "until a number": (lambda: run(until=3), "`until` must be a function"),
    "negative bond tolerance": (
        lambda: run(bond_tolerance=-1.0),
        "`bond_tolerance` must be positive",
    ),
    "bonds of wrong length": (
        lambda: run(State(1.1 * START.position)),
        "`state` must hold neighbours at touching distance, but beads 0 and 1 are off it by 10 %",
    ),
    "controller a string": (
        lambda: Diffrax(diffrax.Tsit5(), controller="pid"),
        "`controller` must be",
    ),
    "controller for Euler": (
        lambda: Diffrax(diffrax.Euler(), controller=PID),
        "`controller` must be None for a solver that does not estimate its error, but Euler does",
    ),
    "implicit solver without controller": (
        lambda: Diffrax(diffrax.Kvaerno3(), substeps=3),
        "`controller` must be given with an implicit solver",
    ),
    "two shear rates": (lambda: Shear([1.0, 2.0]), "`rate` must have shape ()"),
    "NaN phase": (lambda: OscillatingShear(1.0, 1.0, NAN), "`phase` must be finite"),
    "force that is no function": (lambda: ForceField(None), "`function` must be a function"),
    "discrete curvature a string": (
        lambda: Bending(1.0, 0.0, "sine"),
        "`discrete_curvature` must be",
    ),
    "no shear": (lambda: scenes.jeffery(5, shear_rate=0.0), "`shear_rate` must be positive"),
    "large amplitude": (
        lambda: scenes.relaxation(6, 1, amplitude=0.5),
        "`amplitude` must be small (at most 0.01)",
    ),
}

MANY = jax.tree.map(lambda x: jnp.stack([x, x, x]), START)
INSTANTS = {
    name: (
        lambda of=of: of(0.0, MANY, model()),
        "`state` must be one state (of many: `jax.vmap` over `solution.ts, solution.states`), but its "
        "positions have shape (3, 5, 2)",
    )
    for name, of in {
        "tension": observables.tension,
        "holding_load": observables.holding_load,
        "power": observables.power,
        "settling_velocity": observables.settling_velocity,
        "load_on_fluid": observables.load_on_fluid,
        "elastic_energy": observables.elastic_energy,
        "applied_load": applied_load,
    }.items()
} | {
    "load of several holders": (
        lambda: observables.holding_load(0.0, START, model(), (0, 3)),
        "`bead` must be one index (of several, call it for each), but it is a tuple",
    ),
    "load of an array of holders": (
        lambda: observables.holding_load(0.0, START, model(), jnp.array([0, 3])),
        "`bead` must be one index (of several, call it for each), but it is an ArrayImpl",
    ),
}
CASES = INSTANTS | OPTIONS | CHAINS | STATES | TERMS | DRIVES | STEPS | SCENES


@pytest.mark.parametrize("call, says", CASES.values(), ids=CASES)
def test_bad_input_is_refused_in_one_sentence(call, says, untraced):
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        call()
    sentence(caught.value)


@pytest.mark.parametrize("go", [lambda: run(), lambda: rollout(model(), START, TIMES)])
def test_good_input_gets_as_far_as_tracing(go, untraced):
    # Otherwise the test above would not show that bad input is refused earlier.
    with pytest.raises(AssertionError, match="not refused in time"):
        go()


def test_what_is_traced_passes():
    # Values are not known while tracing, so nothing can be said of them, not even nonsense.
    def build(x):
        chain = Chain(x, 5)
        state = straight(chain, jnp.stack([x, x, x]), jnp.stack([x, x, x]))
        flow = LinearFlow(x * jnp.eye(3))
        scene = model(chain, x, forces=[Bending(x, x), Weight([x, x, x])], flow=flow)
        check(scene, state, overlap=False)
        return from_tangents(chain, x * jnp.ones((4, 2)))

    assert jax.eval_shape(build, jnp.asarray(-1.0)).shape == (5, 2)


def test_overlap_is_allowed_unless_refused():
    chain = Chain(1.0, (2, 3))
    check(model(chain), straight(chain, [1, 0], [[0, 0], [3, 1.5]]))


def test_a_trace_that_is_rounding_passes():
    flow = LinearFlow(np.diag([0.1, 0.2, -0.3]).astype(np.float32) * 1e5)
    assert float(jnp.trace(flow.matrix)) != 0
    check(model(flow=flow), SPATIAL)


def test_single_precision_runs_when_asked_for():
    solution = run(single(START), scene=single(model()), single_precision=True)
    assert solution.states.position.dtype == jnp.float32
    assert np.all(np.isfinite(solution.states.position)) and len(solution.ts) == len(TIMES)


def test_redundant_constraints_are_named():
    with pytest.raises(
        ValueError, match=r"Gears \+ Gears are redundant: 8 of their rows"
    ) as caught:
        run(scene=model(constraints=[Gears(), Gears()]))
    sentence(caught.value)


@pytest.mark.parametrize(
    "where, why",
    [
        ("", "Is a directory"),
        ("none/run.h5", "No such file or directory"),
        ("text/run.h5", "Not a directory"),
    ],
)
def test_a_file_that_cannot_be_written(where, why, tmp_path, unrun):
    (tmp_path / "text").write_text("no folder")
    path = tmp_path / where
    says = f"`file` must be a path that can be written, but {path} is not: {why}."
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        run(file=path)
    sentence(caught.value)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.h5"
    run(file=path, until=lambda solution: len(solution.ts) > 2, substeps=1)
    assert len(load(path).ts) == 3
    return path


def cut(path):
    path.write_bytes(path.read_bytes()[:-1000])


def scramble(path):
    data = path.read_bytes()
    path.write_bytes(data[:2000] + bytes(4000) + data[6000:])


def replace(path):
    path.unlink()
    with h5py.File(path, "w") as handle:
        handle["x"] = 1.0


def without(name):
    def delete(path):
        with h5py.File(path, "r+") as handle:
            if name in handle.attrs:
                del handle.attrs[name]
            else:
                del handle[name]

    return delete


def shorten(path):
    with h5py.File(path, "r+") as handle:
        handle["position"].resize(2, axis=0)


def later(path):
    with h5py.File(path, "r+") as handle:
        handle.attrs["format"] = 3


def earlier(path):
    """As version 0.2 began: solvers did not carry their own options."""
    with h5py.File(path, "r+") as handle:
        text = handle["model"].asstr()[()]
        del handle["model"]
        handle["model"] = text.replace('"solver.', '"')


DAMAGE = {
    "missing": (lambda path: path.unlink(), "must name a trajectory file, but .* does not exist"),
    "text": (lambda path: path.write_text("hello\n"), "cannot be read: file signature not found"),
    "truncated": (cut, "must be a trajectory file, but .* cannot be read: truncated file"),
    "scrambled": (scramble, "must be (whole|a trajectory file)"),
    "another HDF5 file": (
        replace,
        "must be a trajectory file of format 2, but .* lacks .*position",
    ),
    "another format": (without("format"), "of format 2, but .* lacks its format mark"),
    "a later format": (later, "of format 2, but .* is of format 3, of another version"),
    "an earlier version": (earlier, r"of jaxbeads to be continued, but .* \(`load` reads it\)"),
    "no checkpoint": (without("checkpoint"), "must be whole, but .* lacks checkpoint/./0"),
    "part of the checkpoint": (without("checkpoint/1"), "but .* lacks checkpoint/1"),
    "no residuals": (without("residual"), "must be a trajectory file .* lacks residual"),
    "no mark": (without("mark"), "must be a trajectory file .* lacks mark"),
    "a state too few": (shorten, "must hold whole states at its planned times"),
}


@pytest.mark.parametrize("damage, says", DAMAGE.values(), ids=DAMAGE)
def test_a_file_that_cannot_be_continued(damage, says, written, tmp_path, unrun):
    path = shutil.copy(written, tmp_path / "copy.h5")
    damage(path)
    with pytest.raises(ValueError, match=says) as caught:
        resume(path, model(), substeps=1, progress=False)
    assert sentence(caught.value).startswith("Argument `file`") and str(path) in str(caught.value)


def test_a_file_of_an_earlier_version_is_read(written, tmp_path):
    path = shutil.copy(written, tmp_path / "copy.h5")
    earlier(path)
    assert np.array_equal(load(path).states.position, load(written).states.position)


OTHERS = {
    "rigidity": (
        {"forces": [Bending(11.0)]},
        {},
        r"`scene.forces\[0\].rigidity` was 10.0 and is 11.0",
    ),
    "one rigidity": (
        {"forces": [Bending([10.0, 10.0, 1.0])]},
        {},
        r"`scene.forces\[0\].rigidity` had shape \(\) and has \(3,\)",
    ),
    "viscosity": ({"viscosity": 2.0}, {}, r"`scene.viscosity` was 1.0 and is 2.0"),
    "law": (
        {"forces": [Bending(10.0, 0.0, SineRuleCurvature())]},
        {},
        r"`scene.forces\[0\]..*` was .* and is .*SineRuleCurvature",
    ),
    "another force": (
        {"forces": [Bending(10.0), Weight([0, 1])]},
        {},
        r"`scene.forces` was \(Bending\) and is \(Bending, Weight\)",
    ),
    "no flow": ({"flow": None}, {}, "`scene.flow` was Shear and is None"),
    "beads": ({"chain": Chain(1.0, 6)}, {}, r"`scene.chain.fibres\[0\]` was 5 and is 6"),
    "solver": ({}, {"solver": diffrax.Heun()}, "`solver` was AB3 and is Diffrax"),
    "substeps": ({}, {"solver": AB3(substeps=7)}, "`solver.substeps` was 1 and is 7"),
    "projected": (
        {},
        {"solver": AB3(substeps=1, projected=True)},
        "`solver.projected` was False and is True",
    ),
    "steps of another kind": (
        {},
        {"solver": Rosenbrock(tolerance=1e-5)},
        "`solver` was AB3 and is Rosenbrock",
    ),
}


@pytest.mark.parametrize("terms, options, says", OTHERS.values(), ids=OTHERS)
def test_a_file_of_another_run_is_not_continued(terms, options, says, written, tmp_path, unrun):
    path = shutil.copy(written, tmp_path / "copy.h5")
    with pytest.raises(
        ValueError, match=f"`scene` must be the scene .*written, but {says}"
    ) as caught:
        resume(path, model(**terms), progress=False, **(options or {"substeps": 1}))
    sentence(caught.value)
    resumed = load(path)  # and the file is as it was
    assert len(resumed.ts) == 3


@pytest.mark.parametrize(
    "words, says",
    [
        (
            "jeffery --beads 4 --solver nonsense",
            "`--solver` must be Rosenbrock, ESDIRK, AB3 or .* but it is 'nonsense'",
        ),
        (
            "jeffery --beads 4 --solver Euler",
            "`--solver` must be Rosenbrock, ESDIRK, AB3 or the name",
        ),
        (
            "jeffery --beads 4 --solver HalfSolver",
            "`--solver` must be Rosenbrock, .* 'HalfSolver'",
        ),
        (
            "jeffery --beads 4 --solver KenCarp4",
            "`--solver` must be Rosenbrock, ESDIRK, AB3 or .* 'KenCarp4'",
        ),
        (
            "jeffery --beads 4 --out text",
            "`--out` must be a folder .*, but text is not: File exists",
        ),
        ("jeffery --beads 4 --out text/in", "`--out` must be a folder .*: Not a directory"),
        ("shear --beads 2", "`beads` must be at least 3, but it is 2"),
        ("relaxation --beads 5 --mode 9", "`mode` must be at most 3"),
        ("settling --elasto-gravitational -1", "`elasto_gravitational` must be positive"),
    ],
)
def test_the_shell_says_it_too(words, says, capsys, tmp_path, monkeypatch, untraced):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text").write_text("no folder")
    assert main(words.split()) == 1
    printed = capsys.readouterr()
    assert re.search(says, sentence(printed.err.rstrip("\n"))) and not printed.out


TRACED = {
    "grad": lambda f: jax.grad(lambda k: f(k).states.position.sum())(1.0),
    "jit": lambda f: jax.jit(lambda k: f(k).states.position)(1.0),
    "vmap": lambda f: jax.vmap(lambda k: f(k).states.position)(jnp.ones(2)),
    "jit of nothing": lambda f: jax.jit(lambda: f(1.0).states.position)(),
}
WATCHED = {
    "scene": lambda k: run(scene=model(forces=[Bending(k)])),
    "law": lambda k: run_force(ForceField(lambda t, x: k * x)),
    "state": lambda k: run(State(k * START.position)),
    "times": lambda k: run(ts=k * TIMES),
    "tolerance": lambda k: run(tolerance=1e-3 * k),
    "own tolerance": lambda k: run(solver=Rosenbrock(tolerance=1e-3 * k)),
    "controller": lambda k: run(
        solver=Rosenbrock(controller=diffrax.PIDController(rtol=0.0, atol=1e-6 * k))
    ),
}


@pytest.mark.parametrize("transform", TRACED.values(), ids=TRACED)
@pytest.mark.parametrize("watched", WATCHED.values(), ids=WATCHED)
def test_transformations_of_simulate_are_told_to_use_rollout(watched, transform, untraced):
    with pytest.raises(ValueError, match=r"`simulate` must see.* use `rollout`") as caught:
        transform(watched)
    sentence(caught.value)


def test_transformations_of_resume_are_told_to_use_rollout(written, unrun):
    def resumed(k):
        terms = {"forces": [Bending(10.0 * k)]}
        return resume(written, model(**terms), substeps=1, progress=False)

    for transform in TRACED.values():
        with pytest.raises(ValueError, match=r"`resume` must see.* use `rollout`") as caught:
            transform(resumed)
        sentence(caught.value)


def test_one_bead_with_gears_runs():
    # There is nothing to constrain, which is no fault.
    lone = Scene(Chain(1.0, 1), 1.0, constraints=[Gears()], forces=[Weight([0.0, -6 * np.pi])])
    end = run(State([[0.0, 0.0]]), scene=lone, substeps=1).final.position
    assert np.allclose(end, [[0.0, -0.8]])


def test_what_is_not_a_number_is_said():
    for wrong in (None, "one", [[1.0], [1.0, 2.0]]):
        with pytest.raises(ValueError, match="A number or an array of numbers is needed"):
            Chain(wrong, 5)
