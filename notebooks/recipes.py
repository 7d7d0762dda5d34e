# ---
# jupyter:
#   jupytext:
#     cell_metadata_filter: -all
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Recipes
#
# Short answers to "How do I ...?", each with a few lines that run and a check that they do what they
# say. Scenes are small, so that all of them together take a minute, most of it for compiling. Unless a
# recipe says otherwise, bead radius, viscosity and weight of a bead are 1, and fibres are planar: two
# coordinates, in a three-dimensional fluid.
#
# Runs: weight, results, tables, pictures, flow, ParaView, units, tolerances, solvers, files, breakdowns.
# Terms: held ends, forces, rigidities, heads, waves, flows, walls, contact, your own. Many runs: gradients,
# batches, sweeps, optimisation, steady and periodic states. Rigid bodies and their motors.

# %%
import tempfile
import warnings
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)  # before anything else

import jaxbeads as jb
import jaxbeads.plot
from jaxbeads import observables
from jaxbeads.constraint import Gears, PrescribedPosition, clamped, hinged
from jaxbeads.flow import Shear, VelocityField
from jaxbeads.force import Bending, Contact, Potential, Weight

temporary = tempfile.TemporaryDirectory()
folder = Path(temporary.name)

# %% [markdown]
# ## Runs
#
# ### How do I compile only once?
#
# `enable_cache` keeps compiled programs on disk: the next process that runs scenes of the same shapes
# finds them. Within a process a program serves all numbers of one shape: another rigidity,
# viscosity or tolerance compiles nothing; another number of beads or another kind of term does.

# %%
cache = jb.enable_cache()  # in the user's cache folder, or one that you name
assert cache.is_dir()

# %% [markdown]
# ### How do I let a fibre fall?
#
# A `Scene` is a chain, a viscosity and terms. `Gears` holds the beads together, `Bending` is the
# elasticity, `Weight` a force on each bead. `simulate` follows the scene from a `State`, and saves at the
# times that it is given.

# %%
chain = jb.Chain(radius=1.0, fibres=8)  # length L = 16
start = jb.straight(chain, direction=[1.0, 0.0])
ts = np.linspace(0.0, 400.0, 41)


def falling(rigidity=20.0, chain=chain, viscosity=1.0, weight=1.0):
    forces = [Weight(jnp.array([0.0, -1.0]) * weight), Bending(rigidity)]
    return jb.Scene(chain, viscosity, constraints=[Gears()], forces=forces)


scene = falling()
solution = jb.simulate(scene, start, ts, progress=False)
print(solution)
assert solution.status == "finished" and solution.final.position[:, 1].max() < -10

# %% [markdown]
# ### How do I read the result?
#
# States have an axis of times in front. `observables` has functions of positions, which take any axes in
# front, and of one state. `residual` says how well velocities meet the constraints, `bond_length_error`
# how well bonds kept their lengths.

# %%
position = np.asarray(solution.states.position)  # (times, beads, dim)
curvature = np.asarray(observables.curvature(solution.states.position, chain))  # (times, joints)
speed = observables.settling_velocity(solution.ts[-1], solution.final, scene)  # of the last state
print("largest curvature times L:", np.abs(curvature[-1]).max() * float(chain.length[0]))
print("residual", solution.residual.max(), "bonds", solution.bond_length_error.max())
assert position.shape == (41, 8, 2) and curvature.shape == (41, 6)
assert solution.residual.max() < 1e-12 and solution.bond_length_error.max() < 1e-12

# %% [markdown]
# ### How do I get a table of it?
#
# `to_xarray` labels all of a solution: `to_netcdf` makes it a file that other programs read, `to_dataframe`
# a table of `pandas`. `to_csv` writes what was measured over time as text, with all digits; of several
# components each has its column.

# %%
table = solution.to_xarray(chain)  # the chain adds fibres, radii and arclengths
table.to_netcdf(folder / "fall.nc")
tip = table.position.isel(bead=-1).sel(component="y")
jb.to_csv(folder / "fall.csv", solution.ts, {"tip": tip, "centre": position.mean(axis=1)})
print(table)
with open(folder / "fall.csv") as file:
    assert file.readline() == "time,tip,centre_0,centre_1\n"
    assert np.array_equal(np.loadtxt(file, delimiter=",")[:, 1], tip)

# %% [markdown]
# ### How do I make a picture and a movie?
#
# `jaxbeads.plot` returns `matplotlib` figures and writes gifs; a `View` follows the fibre, or stretches
# an axis. `shapes` takes states between which the shape changes equally much.

# %%
view = jaxbeads.plot.View(co_moving=True)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
jaxbeads.plot.shapes(solution, chain, view=view, axes=axes[0])
jaxbeads.plot.kymograph(solution, chain, axes=axes[1])
plt.show()
movie = jaxbeads.plot.movie(solution, chain, folder / "fall.gif", frames=12, view=view)
assert movie.stat().st_size > 1000

# %% [markdown]
# ### How do I draw the flow?
#
# `flow_field` is the velocity of the fluid at one instant, a function of points; `plot.flow` draws its
# streamlines and speed. `co_moving=True` shows it as seen from the fibre.

# %%
field = jb.flow_field(solution.ts[-1], solution.final, scene)
jaxbeads.plot.flow(field, chain, margin=0.3, number=40)
plt.show()
far = field(jnp.array([[200.0, 0.0], [400.0, 0.0]]))
assert far[0, 1] < far[1, 1] < 0  # the fluid falls along, less and less

# %% [markdown]
# ### How do I look at it in ParaView?
#
# With the extra `paraview` (`pip install '.[paraview]'`). Open `fall.pvd`; the filter Glyph (spheres, scale
# array `radius`, scale factor 2, all points) shows beads to scale, Tube (scalars `radius`, by absolute
# scalar) the fibres. Colours can be those of `curvature`, `force`, `velocity`, ... Open `flow.vti` beside it
# for the fluid at one instant, here on the plane of the fibre.

# %%
jb.to_paraview(solution, scene, folder / "fall.pvd")
low, high = position[-1].min(axis=0) - 10.0, position[-1].max(axis=0) + 10.0
field = jb.flow_field(solution.ts[-1], solution.final, scene)
flow = jb.flow_to_paraview(
    field, folder / "flow.vti", bounds=np.stack([low, high], axis=1), shape=(40, 40)
)
print(len(list((folder / "fall").glob("*.vtp"))), "instants;", flow.name)
assert len(list((folder / "fall").glob("*.vtp"))) == len(solution.ts)

# %% [markdown]
# ### How do I use micrometres, piconewtons and seconds?
#
# The code knows no units: any consistent ones will do, and results come out in the same. With
# micrometres, piconewtons and seconds the viscosity of water is $10^{-3}$ pN s/um$^2$, rigidities are
# in pN um$^2$, speeds in um/s, powers in pN um/s. To work with numbers near one, choose a length $a$
# and a force $F$; with $T = \mu a^2/F$ as the unit of time the viscosity is 1, and the unit of rigidity is
# $F a^2$.

# %%
mu, a, K_b, w = 1e-3, 0.5, 5.0, 0.2  # pN s/um^2, um, pN um^2, pN on each bead
length, force = a, w
time = mu * length**2 / force  # s

physical = falling(K_b, jb.Chain(a, 8), mu, w)
scaled = falling(K_b / (force * length**2), jb.Chain(a / length, 8), 1.0, w / force)
seconds = np.linspace(0.0, 0.5, 41)
there = jb.simulate(physical, jb.straight(physical.chain, [1.0, 0.0]), seconds, progress=False)
here = jb.simulate(scaled, start, seconds / time, progress=False)
fall = observables.settling_velocity(0.5, there.final, physical)  # um/s
back = observables.settling_velocity(0.5 / time, here.final, scaled) * length / time
print(f"unit of time {time:.3g} s; it falls at {-fall[1]:.4g} um/s, {-back[1]:.4g} by the other")
assert np.abs(fall - back).max() < 1e-9 * np.abs(fall).max()
assert np.abs(here.states.position * length - there.states.position).max() < 1e-9 * 8 * a

# %% [markdown]
# ### How do I choose a tolerance?
#
# `tolerance` is the largest error of a step, as a fraction of the longest fibre's length; the error of
# the path is of the same size where neighbouring paths converge. For a picture `1e-4` is enough, for a
# number take the default, `1e-6`, and once a tenth of it to see what changes. For a gradient through
# many steps take equal steps (`substeps`), or `1e-8`: steps that are chosen by their error change with
# the parameters, and differences of results are as rough as the tolerance.

# %%
exact = jb.simulate(scene, start, ts, tolerance=1e-10, progress=False)
for tolerance in (1e-4, 1e-6, 1e-8):
    run = jb.simulate(scene, start, ts, tolerance=tolerance, progress=False)
    apart = np.abs(run.states.position - exact.states.position).max() / float(chain.length[0])
    print(f"tolerance {tolerance:.0e}: {int(run.steps):3d} steps, error {apart:.0e} L")
    assert apart < 10 * tolerance

# %% [markdown]
# ### How do I choose the solver?
#
# Leave it out: stiff scenes get `Rosenbrock` (large ones `ESDIRK`, which needs no matrix of the
# whole), others `diffrax.Tsit5`. `AB3` is the explicit scheme of
# the paper, with equal steps; `substeps=` is short for it. An explicit step must resolve the fastest
# bending: `solver.explicit_step` is eq. (39) of the paper, and AB3 is stable to about 2.2 times it. Any
# Runge-Kutta method of `diffrax` goes as well, as `solver=diffrax.Dopri5()`, which is used below.

# %%
substeps = jb.solver.substeps_for(scene, ts)  # between two save times
paper = jb.AB3(substeps=substeps)
run = jb.simulate(scene, start, ts, solver=paper, progress=False)
apart = np.abs(run.states.position - exact.states.position).max() / float(chain.length[0])
print(f"{run.solver}: {int(run.steps)} steps, error {apart:.0e} L; default: {int(solution.steps)}")
assert apart < 1e-5

# %% [markdown]
# ### How do I run many fibres?
#
# Above 1000 beads no matrix of all of them is kept, and the default solver is `ESDIRK`: its stages are
# iterated, a product with the mobility at a time. For several fibres it is the default from 100 beads
# on, and worth choosing below that; errors over a path are ten to forty times its tolerance.

# %%
many = jb.Chain(radius=1.0, fibres=[6, 4, 5])
places = [[0.0, 0.0], [9.0, 0.0], [20.0, 3.0]]
apart = jb.straight(many, [[1.0, 0.5], [0.2, 1.0], [1.0, 0.0]], places)
forces = [jb.force.Weight([0.0, -1.0]), jb.force.Bending(50.0)]
together = jb.Scene(many, 1.0, constraints=[jb.constraint.Gears()], forces=forces)
ends = [
    jb.simulate(together, apart, [0.0, 300.0], solver=solver, progress=False).final.position
    for solver in (jb.ESDIRK(tolerance=1e-6), jb.Rosenbrock(tolerance=1e-8))
]
assert np.abs(ends[0] - ends[1]).max() < 3e-5 * float(many.length[0])

# %% [markdown]
# ### How do I save, load and resume?
#
# With `file` the run is written while it goes, and Ctrl-C or a kill leaves a valid file. `load` reads
# it; `resume` goes on from its end, bit for bit as if nothing had happened, with the same scene and
# solver. `until` ends a run early, here in place of an interrupt.

# %%
half = jb.simulate(
    scene, start, ts, file=folder / "fall.h5", until=lambda s: s.ts[-1] >= 200, progress=False
)
print(half.status, "at", float(half.ts[-1]), "-", jb.load(folder / "fall.h5").status)
jb.resume(folder / "fall.h5", scene, progress=False)
whole = jb.load(folder / "fall.h5")
assert half.ts[-1] == 200 and whole.status == "finished"
assert np.array_equal(whole.states.position, solution.states.position)

# %% [markdown]
# ### How do I find out why it stopped?
#
# `simulate` raises `SimulationError`: its message names step, bead and term and says what to do, `cause`
# has the same in parts, and `solution` ends with the last good state. `rollout` cannot raise: its `code`
# is 0 if all went well, and `Outcome` has the sentence for any other. Here as many steps as before go
# between times that are ten times as far apart: each is too long.

# %%
try:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of such steps beforehand
        jb.simulate(scene, start, ts[::10], solver=paper, progress=False)
except jb.SimulationError as error:
    print(error)
    cause, good = error.cause, error.solution
print("step", cause.step, "bead", cause.bead, "at", cause.time, "-", good.status)
code = int(jb.rollout(scene, start, ts[::10], solver=paper).code)
print(code, jb.Outcome(code).sentence)
assert cause.step < substeps and good.status == "broken down" and code == jb.Outcome.BROKEN

# %% [markdown]
# ## Terms
#
# Constraints and forces are lists; a flow and a domain are one each. One instant is enough to see what a
# term does: `dynamics.motion` has the velocities and spins of all beads.
#
# ### How do I hold an end?
#
# `hinged(0)` holds the first bead and lets it turn, `hinged(-1)` the last one. It is a tuple of
# constraints, so it is unpacked with `*`.

# %%
held = jb.Scene(
    chain,
    1.0,
    constraints=[Gears(), *hinged(0)],
    forces=[Weight([0.0, -1.0]), Bending(20.0)],
)
motion = jb.dynamics.motion(0.0, start, held)
print("first and last bead move at", motion.velocity[0], motion.velocity[-1])
assert np.abs(motion.velocity[0]).max() < 1e-14 and motion.velocity[-1, 1] < 0

# %% [markdown]
# ### How do I clamp an end?
#
# `clamped(0)` holds the first bead, its spin and the direction of its bond, so that two beads are at
# rest; `clamped(-1)` does it at the last.


# %%
def cantilever(rigidity, load):
    tip = jnp.zeros((8, 2)).at[-1, 1].set(-load)  # a force on each bead: here on the last one
    forces = [Weight(tip), Bending(rigidity)]
    return jb.Scene(chain, 1.0, constraints=[Gears(), *clamped(0)], forces=forces)


motion = jb.dynamics.motion(0.0, start, cantilever(20.0, 1.0))
assert np.abs(motion.velocity[:2]).max() < 1e-14 and abs(motion.spin[0, 0]) < 1e-14
assert motion.velocity[-1, 1] < 0

# %% [markdown]
# ### How do I clamp several fibres?
#
# By an index for each: `chain.first_beads` and `chain.last_beads` have them.

# %%
row_of_two = jb.Chain(1.0, fibres=(5, 5))
sheared = jb.Scene(
    row_of_two,
    1.0,
    constraints=[Gears(), *clamped(row_of_two.first_beads)],
    forces=[Bending(20.0)],
    flow=Shear(0.1),
)
upright = jb.straight(row_of_two, [0.0, 1.0], centre=[[0.0, 4.0], [6.0, 4.0]])
motion = jb.dynamics.motion(0.0, upright, sheared)
assert np.abs(motion.velocity[np.array([0, 1, 5, 6])]).max() < 1e-14
assert motion.velocity[4, 0] > 0 and motion.velocity[9, 0] > 0

# %% [markdown]
# ### How do I get the force on a clamp, and the tension along a fibre?
#
# `holding_load` is what the holder of a bead exerts on the fibre, force and torque; the fibre pulls at
# its holder with minus that. `tension` has a number for each bond. Both are of one state: over time they
# are mapped by `jax.vmap`. A fibre that hangs at rest is carried by its clamp, each bond by what is below.

# %%
hanging = jb.Scene(
    chain,
    1.0,
    constraints=[Gears(), *clamped(0)],
    forces=[Weight([0.0, -1.0]), Bending(20.0)],
)
down = jb.straight(chain, [0.0, -1.0])
force, torque = observables.holding_load(0.0, down, hanging, bead=0)
sol = jb.rollout(hanging, down, [0.0, 1.0, 2.0], substeps=10)
tensions = jax.vmap(lambda t, s: observables.tension(t, s, hanging))(sol.ts, sol.states)
print("force", force, "torque", torque, "tensions at the end", tensions[-1])
assert np.abs(force - np.array([0.0, 8.0])).max() < 1e-9 and tensions.shape == (3, 7)
assert np.abs(tensions - np.arange(7, 0, -1)[None]).max() < 1e-9

# %% [markdown]
# ### How do I pull at one bead?
#
# `Weight` takes one force for all beads, `(dim,)`, or one for each, `(beads, dim)`: zeros but for the
# bead that is pulled. (The clamped fibre above is pulled at its tip.) A force that changes in time is
# one of your own, see below.

# %%
pull = np.zeros((8, 2))
pull[3] = [0.0, 1.0]
pulled = jb.Scene(chain, 1.0, constraints=[Gears()], forces=[Weight(pull), Bending(20.0)])
motion = jb.dynamics.motion(0.0, start, pulled)
print("bead that moves fastest:", int(np.argmax(motion.velocity[:, 1])))
assert np.argmax(motion.velocity[:, 1]) == 3

# %% [markdown]
# ### How do I drive an end?
#
# A law is any function of the time, written with `jax.numpy`; its derivative is enforced, so it must
# not jump. `PrescribedPosition` moves a bead, `PrescribedDirection` turns a bond, `PrescribedSpin` turns
# a bead; ready laws are in `jaxbeads.actuation`.

# %%
shaken = PrescribedPosition(lambda t: jnp.array([0.0, 0.3 * jnp.sin(2 * t)]), bead=0)
driven = jb.Scene(chain, 1.0, constraints=[Gears(), shaken], forces=[Bending(20.0)])
motion = jb.dynamics.motion(0.0, start, driven)
assert np.abs(motion.velocity[0] - np.array([0.0, 0.6])).max() < 1e-14

# %% [markdown]
# ### How do I have two fibres of different rigidity?
#
# `fibres` are the numbers of beads, and a rigidity may be given for each joint. The array has
# `beads - 2` entries for all fibres in a row; those at bead 5 and 6 here, where one fibre ends and the
# next begins, are not used. The softer fibre (the first) bends more.

# %%
pair = jb.Chain(1.0, fibres=(6, 6))
fibre = pair.fibre_of_bead[1:-1]
soft_and_stiff = jb.Scene(
    pair,
    1.0,
    constraints=[Gears()],
    forces=[Weight([0.0, -1.0]), Bending(jnp.where(fibre == 0, 5.0, 50.0))],
)
apart = jb.straight(pair, [1.0, 0.0], centre=[[0.0, 0.0], [40.0, 0.0]])
run = jb.rollout(soft_and_stiff, apart, [0.0, 30.0], substeps=100)
ends = observables.end_to_end_distance(run.final.position, pair)  # of each fibre
print("end-to-end distances:", ends)
assert ends[0] < ends[1] < 10.0

# %% [markdown]
# ### How do I have unequal fibres?
#
# By their numbers of beads; radii may differ as well. Directions and centres are given for each fibre.
# Observables that take a `chain` have a value for each of them.

# %%
unequal = jb.Chain(1.0, fibres=(3, 9, 5))
state = jb.straight(
    unequal,
    direction=[[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]],
    centre=[[0.0, 0.0], [20.0, 0.0], [40.0, 0.0]],
)
ends = observables.end_to_end_distance(state.position, unequal)  # of the outer beads' centres
print("lengths", unequal.length, "ends apart", ends)
assert np.allclose(ends, [4.0, 16.0, 8.0])

# %% [markdown]
# ### How do I give it a head?
#
# Radii may be given one by one; neighbours touch, so the bond at the head is longer. The same
# force pulls a fibre with a head more slowly.

# %%
headed = jb.Chain(radius=[2.5] + [1.0] * 7, fibres=8)
print("bonds", headed.bond_length)
along = [
    observables.rigid_resistance(jb.straight(c, [1.0, 0.0]).position, c)[0, 0]
    for c in (chain, headed)
]
print("friction along the axis, without and with a head:", *along)
assert headed.bond_length[0] == 3.5 and along[1] > along[0]

# %% [markdown]
# ### How do I go to three dimensions?
#
# By a direction of three components; vectors of the terms have three as well. For a shape that is not
# straight `from_tangents` takes the directions of the bonds.

# %%
s = np.linspace(0, 1, 7)
tangents = np.stack([np.cos(s), np.sin(s) * np.cos(2 * s), np.sin(s) * np.sin(2 * s)], axis=1)
curved = jb.State(jb.from_tangents(chain, tangents))
spatial = jb.Scene(
    chain, 1.0, constraints=[Gears()], forces=[Weight([0.0, 0.0, -1.0]), Bending(20.0)]
)
motion = jb.dynamics.motion(0.0, curved, spatial)
assert motion.velocity.shape == motion.spin.shape == (8, 3)

# %% [markdown]
# ### How do I make it active?
#
# A preferred curvature that travels along the fibre makes it swim: `TravellingWave`, or any function of
# time, arclength and length. The wave here runs from the first bead to the last, so the filament swims
# the other way. It beats visibly where $2 \pi f \mu L^4/K_b$ is of order 10 or more.

# %%
from jaxbeads.actuation import TravellingWave

period = 1000.0
wave = TravellingWave(amplitude=0.2, wavenumber=2 * np.pi / 16, frequency=1 / period)
swimmer = jb.Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(20.0, wave)])
run = jb.rollout(swimmer, start, np.linspace(0, period, 11), substeps=200)
moved = jb.objectives.displacement(run)
print("displacement in the first period over L:", moved / chain.length[0])
assert run.code == 0 and moved[0] < 0

# %% [markdown]
# ### How do I put it in a flow?
#
# `Shear`, `Extension`, `Poiseuille` and others, or a `VelocityField` of your own, a function of time and
# one point. Beads are carried and turned, and resist the strain.

# %%
bead = jb.Chain(1.0, 1)
off_axis = jb.State([[0.0, 3.0]])
vortex = VelocityField(lambda t, x: 0.2 * jnp.array([-x[1], x[0]]))
for flow, expected in ((Shear(0.5), [1.5, 0.0]), (vortex, [-0.6, 0.0])):
    carried = jb.dynamics.motion(0.0, off_axis, jb.Scene(bead, 1.0, flow=flow))
    assert np.abs(carried.velocity[0] - np.array(expected)).max() < 1e-14

# %% [markdown]
# ### How do I put it near a wall?
#
# By the scene's `domain`: a `NoSlipWall`, or a `FreeSurface`, through a point, with the normal into the
# fluid. Nothing passes a wall; `Contact` keeps beads off it. A single bead at the height $h$ that falls
# towards a no-slip wall is slowed by $1 - \frac98\frac ah + \frac12(\frac ah)^3 - \frac18(\frac ah)^5$.

# %%
floor = jb.NoSlipWall(point=[0.0, 0.0], normal=[0.0, 1.0])
near = jb.Scene(bead, 1.0, forces=[Weight([0.0, -1.0])], domain=floor)
slowed = -6 * np.pi * observables.settling_velocity(0.0, jb.State([[0.0, 2.0]]), near)[1]
x = 1 / 2
print("slowed by", slowed)
assert abs(slowed - (1 - 9 / 8 * x + x**3 / 2 - x**5 / 8)) < 1e-12

# %% [markdown]
# ### How do I keep beads from passing through one another?
#
# Neighbours are held by the chain; for all others add `Contact(strength, roughness, decay)`: a
# repulsion that sets in where surfaces are closer than the roughness, is half the strength where they
# touch, and grows exponentially deeper. Choose the strength several times the forces that press. Two
# beads that are pressed together by a force $F$ rest where $F/F_0 = \frac12 - \mathrm{gap}/2\delta$.

# %%
two = jb.Chain(1.0, fibres=(1, 1))
press = Weight([[1.0, 0.0], [-1.0, 0.0]])
pressed = jb.Scene(two, 1.0, forces=[press, Contact(strength=5.0, roughness=0.3, decay=0.3)])
run = jb.simulate(
    pressed, jb.State([[-3.0, 0.0], [3.0, 0.0]]), np.linspace(0, 200, 5), progress=False
)
gap = float(run.final.position[1, 0] - run.final.position[0, 0]) - 2.0
print("gap", gap)
assert abs(gap - 0.3 * (1 - 2 * 1.0 / 5.0)) < 1e-4

# %% [markdown]
# ### How do I add a force of my own?
#
# `ForceField` takes a function of time and positions that returns forces, `Potential` one that returns
# an energy. A function whose parameters are to be varied is an `equinox.Module`. Anything else (torques,
# forces that read the chain, constraints) is a class with one method: see `your_own_terms`. Here a trap
# pulls a bead to the origin: its distance falls like $e^{-kt/6\pi\mu a}$.


# %%
class Trap(eqx.Module):
    stiffness: jax.Array

    def __call__(self, t, x):
        return 0.5 * self.stiffness * jnp.sum(x**2)


trapped = jb.Scene(bead, 1.0, forces=[Potential(Trap(jnp.array(2.0)))])
away = jb.State([[1.0, 0.0]])
run = jb.simulate(trapped, away, np.linspace(0, 20, 5), solver=diffrax.Dopri5(), progress=False)
print(f"{run.solver}: left of the distance", run.final.position[0, 0])
assert abs(run.final.position[0, 0] - np.exp(-2.0 * 20 / (6 * np.pi))) < 1e-5

# %% [markdown]
# ## Many runs
#
# ### How do I differentiate a result?
#
# `rollout` is a pure function: write the result as a function of the parameter, and let `jax.grad` go
# through it. Few results of many numbers: `jax.grad`; many results of few numbers: `jax.jacfwd`.
# Number the steps beforehand, for the stiffest fibre: where the rigidity is traced it is not known.

# %%
times = np.linspace(0.0, 80.0, 3)
substeps = jb.solver.substeps_for(falling(40.0), times)


def span(rigidity):
    run = jb.rollout(falling(rigidity), start, times, substeps=substeps)
    return observables.end_to_end_distance(run.final.position)


value, slope = jax.jit(jax.value_and_grad(span))(20.0)
print("span", value, "derivative by the rigidity", slope)

# %% [markdown]
# ### How do I run a batch?
#
# `jax.vmap` over the same function. Here it also checks the derivative by a difference. On a CPU the
# members take as long as one after the other; for many, and for more than one core, take `sweep`.

# %%
spans = jax.jit(jax.vmap(span))(jnp.array([20.0 - 1e-3, 20.0 + 1e-3, 40.0]))
print("spans", spans)
assert abs((spans[1] - spans[0]) / 2e-3 / slope - 1) < 1e-6

# %% [markdown]
# ### How do I sweep over parameters, on two devices?
#
# `sweep` runs all combinations by one compiled program and returns a labelled table. A member that
# breaks down has NaN and a `code` of its own and changes no other. It uses the devices there are: to
# make two of a CPU's cores, say `jax.config.update("jax_num_cpu_devices", 2)` before anything else.
# With `folder=` every chunk is kept when it is done, and the same call goes on from there. The table is
# an `xarray.Dataset`: `table.to_netcdf("table.nc")`.


# %%
def build(rigidity, weight):  # a value of each axis
    return falling(rigidity, weight=weight), start


def measure(solution, scene):
    return {"span": observables.end_to_end_distance(solution.final.position)}


table = jb.sweep(
    build,
    {"rigidity": [10.0, 20.0, 40.0], "weight": [0.5, 1.0]},
    times,
    measure,
    substeps=substeps,
    progress=False,
)
print(len(jax.local_devices()), "device(s);", table.span.sel(weight=1.0).values)
assert np.all(table.code == 0)
assert abs(float(table.span.sel(rigidity=20.0, weight=1.0)) - value) < 1e-12

# %% [markdown]
# ### How do I sweep in several processes, as on a cluster?
#
# The same script runs in each process; they share the chunks, meet in the folder, and each returns the
# whole table. Devices of one process and of two give the same table to the last bit
# (`tests/test_sweep.py` runs a script like this one):
#
# ```python
# address, count, number = sys.argv[1:]
# jax.config.update("jax_enable_x64", True)
# jax.distributed.initialize(address, int(count), int(number))
# table = jb.sweep(build, axes, ts, measure, chunk=16, folder="sweep")
# if jax.process_index() == 0:
#     table.to_netcdf("table.nc")
# ```
#
# ```sh
# python script.py 127.0.0.1:12355 2 0 & python script.py 127.0.0.1:12355 2 1; wait
# ```
#
# Under Slurm `jax.distributed.initialize()` finds its arguments by itself (`srun python script.py`),
# which was not tried here.

# %% [markdown]
# ### How do I optimise a number?
#
# `optimise` minimises a function of numbers by its gradient, within `bounds` and under a `constraint` if
# there are any. At which slope does a row of beads drift sideways most as it falls? Its mobilities along
# and across, $m_\parallel$ and $m_\perp$, say $\tan\theta = \sqrt{m_\perp/m_\parallel}$.

# %%
row = jb.Scene(
    chain, 1.0, forces=[Weight([0.0, -1.0])]
)  # nothing links them: one instant is enough


def velocity(slope):
    along = jnp.stack([jnp.cos(slope), jnp.sin(slope)])
    state = jb.State(jb.from_tangents(chain, jnp.tile(along, (7, 1))))
    return observables.settling_velocity(0.0, state, row)


def drift(slope):  # to be minimised: it drifts to the left of its slope
    v = velocity(slope)
    return -v[0] / v[1]


best = jb.optimise(drift, 0.3, progress=False)
across, along = (-float(velocity(jnp.asarray(x))[1]) for x in (0.0, np.pi / 2))
print(f"{best.status}: slope {np.degrees(best.values):.3f} degrees")
assert abs(best.values - np.arctan(np.sqrt(across / along))) < 1e-6

# %% [markdown]
# ### How do I optimise a wave?
#
# The loss builds the scene from the wave's numbers and runs it. Number the steps beforehand, for the
# stiffest fibre that will be met, or leave them to the tolerance. A run that breaks down does not raise
# in it: look at `code` of the best one. Bounds keep the wave reasonable. Here a fibre of five beads swims
# for one period.

# %%
worm = jb.Chain(1.0, fibres=5)
lying, beat = jb.straight(worm, [1.0, 0.0]), np.linspace(0.0, 100.0, 3)


def waving(wave):
    drive = TravellingWave(wave["amplitude"], wave["wavenumber"], frequency=0.01)
    return jb.Scene(worm, 1.0, constraints=[Gears()], forces=[Bending(20.0, drive)])


guess = {"amplitude": 0.1, "wavenumber": 0.4}
substeps = jb.solver.substeps_for(waving(guess), beat)


def swim(wave):
    return jb.rollout(waving(wave), lying, beat, substeps=substeps)


def backwards(wave):  # to be minimised: it swims against the wave
    return jb.objectives.displacement(swim(wave))[0]


bounds = {"amplitude": 0.0, "wavenumber": 0.0}, {"amplitude": 0.2, "wavenumber": 1.0}
best = jb.optimise(backwards, guess, bounds=bounds, steps=4, progress=False)
run = swim(best.values)
print(best)
assert run.code == 0 and best.loss < 1.5 * backwards(guess) < 0

# %% [markdown]
# ### How do I find a steady shape, and its derivatives?
#
# `steady_state` takes a guess and finds, by Newton's method, the shape that does not change; a free
# fibre may move as a whole meanwhile, a held one must rest (`moving=False`). It says how fast small
# disturbances grow, and is differentiated by the implicit function theorem: nothing is followed through
# time. Under `jit` it cannot raise: look at `converged`. The clamped fibre from above sags like a beam,
# by $P \ell^3/3K_b$ for small loads, where $\ell^3/3$ is a sum over the joints.


# %%
def sagging(rigidity):
    found = jb.steady_state(cantilever(rigidity, 1e-3), start, moving=False)
    return -found.state.position[-1, 1], found


(sag, found), slope = jax.jit(jax.value_and_grad(sagging, has_aux=True))(20.0)
beam = 1e-3 / 20.0 * 2.0 * np.sum((2.0 * np.arange(1, 7)) ** 2)  # six joints, 2 apart
rates = found.growth_rates.real  # 0 of what is held
print("sag", sag, "beam", beam, "derivative times rigidity", 20.0 * slope)
print("slowest relaxation in", -1 / rates[rates < -1e-9].max())
assert bool(found.converged) and rates.max() < 1e-9
assert abs(sag / beam - 1) < 1e-4 and abs(20.0 * slope / sag + 1) < 1e-4

# %% [markdown]
# ### How do I find a periodic state?
#
# `periodic_state` finds the limit cycle of a driven scene by Newton's method: the shape to which it
# returns after a period, how far it moved and turned, and whether the cycle is stable. From there one
# period is measured without a transient: `objectives` has speed, power, efficiency and thrust.

# %%
cycle = jb.periodic_state(swimmer, start, period, solver=jb.AB3(substeps=2000))
print("displacement over L:", cycle.displacement / chain.length[0])
print("largest multiplier but that of turning:", np.abs(cycle.multipliers)[1])
one = jb.rollout(swimmer, cycle.state, np.linspace(0, period, 11), substeps=200)
speed = jb.objectives.swimming_speed(one, swimmer, 1 / period)
print("V/(f L)", speed)
shape = one.states.position - one.states.position.mean(axis=1, keepdims=True)
assert abs(speed - jnp.linalg.norm(cycle.displacement) / chain.length[0]) < 1e-8
assert np.abs(shape[-1] - shape[0] @ np.asarray(cycle.rotation)).max() < 1e-6

# %% [markdown]
# ## Rigid bodies
#
# ### How do I swim a bacterium, with a motor?
#
# Bodies are drawn in one frame, in which joints have their points and axes; an `Assembly` puts them into
# a fluid, each free or joined to another one, or to space (`None`). `locomotion.motion` says how they
# move at one instant, and what their joints bear; `travel` follows them. A `Hinge` with a `drive` is a
# motor of given torque, a `Weld` to space holds a body, and a `Ball` with a `stiffness` is a hook. Your
# own shapes: `jb.Body(points, radii)`, `jb.body.strand(curve, beads)`, `jb.body.read_points(file)`.

# %%
head = jb.body.sphere(3.0, centre=[-4.0, 0.0, 0.0])
tail = jb.body.helix(radius=2.0, pitch=8.0, turns=1)
motor = jb.body.Motor(0, 1, axis=[1.0, 0.0, 0.0], rate=1.0)
bacterium = jb.Assembly([head, tail], viscosity=1.0, joints=[motor])
moved = jb.locomotion.motion(0.0, bacterium.drawn, bacterium)
spin = moved.spin[1]
speed = moved.velocity[1] @ spin / jnp.linalg.norm(spin)  # the path is a helix about this axis
journey = jb.travel(
    bacterium, bacterium.drawn, np.linspace(0, 4 * np.pi, 9) / jnp.linalg.norm(spin)
)
way = journey.final.place[0] - bacterium.drawn.place[0]
jaxbeads.plot.shapes(journey.solution(bacterium), bacterium.chain)
print("motor's torque:", moved.joint_torque[0, 0], "speed:", speed)
assert abs(jnp.linalg.norm(way) / (journey.ts[-1] * speed) - 1) < 1e-5  # over two turns of the tail
assert jnp.abs(moved.load.force.sum(axis=0)).max() < 1e-12 * moved.joint_torque[0, 0]

# %% [markdown]
# ### How do I give a body a flexible tail?
#
# `jb.body.fibre` makes a row of bodies with elastic joints, a bead each, of any shape, which it has at
# rest: bodies and joints go into the `Assembly` with the others. Joints are stiff, so take implicit
# steps. (`jb.scenes.bacterium(flexible=...)` is this one.)

# %%
rigidity = 50.0 * moved.joint_torque[0, 0]
soft = jb.body.fibre(tail, rigidity, twist_rigidity=2 / 3 * rigidity, first=1)
bacterium = jb.Assembly([head, *soft.bodies], 1.0, joints=[motor, *soft.joints])
journey = jb.travel(bacterium, bacterium.drawn, [0.0, 5.0, 10.0], implicit=True)
bent = jnp.linalg.norm(jb.quaternions.angles(journey.poses.turn[:, 2:]), axis=-1)  # at each joint
print("largest bend of a joint:", bent.max(axis=1))
assert jnp.abs(bent[2] - bent[1]).max() < 1e-3 * bent[1].max()  # it turns as a whole by now
