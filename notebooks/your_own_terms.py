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
# # Your own constraint, force, flow and mobility
#
# Every term of a `Scene` is a small class with one method that says what it is. Here four are
# written from scratch, each in fewer than twenty lines, each checked against a number that is known
# exactly, and each differentiated through a short `rollout`:
#
# | term | method | says | checked against |
# |---|---|---|---|
# | constraint | `slip` | a bond turns at a given rate | resistance of a rigid rod to rotation |
# | force | `load` | a magnetic torque $m \times B$ on each bead | the equation of a compass needle |
# | flow | `velocity` | a vortex that spreads by viscosity | how far it carries a point |
# | mobility | `motion` | drag that differs along and across | the largest drift angle of a rod |
#
# Nothing is registered anywhere: the classes go straight into a `Scene`. Units: $a = \mu = 1$, so a
# single bead has the friction $6\pi$ and the rotational friction $8\pi$. Everything is in the
# plane, where a spin and a torque have one component, normal to it.

# %%
from functools import partial
from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxbeads as jb
from jaxbeads.constraint import AbstractConstraint, EqualSpins, Gears
from jaxbeads.flow import AbstractFlow
from jaxbeads.force import AbstractForce, AbstractPotential, Bending, Weight
from jaxbeads.geometry import cross, norm, tangents, unit
from jaxbeads.mobility import RPY, AbstractMobility, FreeDraining

jax.config.update("jax_enable_x64", True)

chain = jb.Chain(radius=1.0, fibres=10)
checks = []  # rows of the table at the end: quantity, measured, reference, allowed difference

# Any `diffrax` solver will do; this one is of fifth order, so a few large steps are enough.
rollout = partial(jb.rollout, solver=diffrax.Tsit5())


def number(x):
    """A parameter of a term: a leaf that can be varied and differentiated."""
    return jnp.asarray(x, float)


# %% [markdown]
# ## A constraint: a bond that turns at a given rate
#
# A constraint is what it sets to zero, as an affine function of the velocities and spins. $J$, $B$
# and the constraint forces $J^T \lambda$ (eqs 5-17 of the paper) follow from it. Here the bond from
# bead $i$ to $i + 1$ shall turn at the rate $\Omega$:
# $$ e \times (v_{i+1} - v_i) / \ell - \Omega = 0 . $$


# %%
class Turning(AbstractConstraint):
    """A bond turns at a rate [1/time]."""

    rotational: ClassVar[bool] = False  # `slip` reads no spins
    rate: jax.Array = eqx.field(converter=number)
    bond: int = eqx.field(static=True, default=0)

    def slip(self, t, state, motion, chain):
        i, j = self.bond, self.bond + 1
        bond = state.position[j] - state.position[i]
        return cross(unit(bond), motion.velocity[j] - motion.velocity[i]) / norm(bond) - self.rate


# %% [markdown]
# The middle bond of a rigid rod of ten beads is driven. The drive then has to exert the torque that
# it takes to rotate the rod, $T = R\,\Omega$ with $R = 167.347576 \cdot 8 \pi \mu a^3$ (independent
# computation). The torque is the sum of all constraint loads, since those of the other constraints
# are internal.


# %%
def driven_rod(rate):
    constraints = [Gears(), EqualSpins(), Turning(rate, bond=4)]
    return jb.Scene(chain, viscosity=1.0, constraints=constraints)


state = jb.straight(chain, direction=[1.0, 0.0])
load = jax.jit(jb.dynamics.constraint_load)(0.0, state, driven_rod(0.3))
torque = jnp.sum(cross(state.position, load.force)) + jnp.sum(load.torque)
checks.append(("torque of the drive / (8 pi rate)", torque / (8 * np.pi * 0.3), 167.347576, 1e-6))


@jax.jit
@jax.value_and_grad
def tip_height(rate):
    run = rollout(driven_rod(rate), state, np.linspace(0, 4.0, 3), substeps=20)
    return run.final.position[-1, 1]


height, slope = tip_height(0.3)
arm = 9.0  # of the last bead's centre from the middle
checks.append(("height of the tip at t = 4", height, arm * np.sin(0.3 * 4), 1e-7))
checks.append(("... its derivative by the rate", slope, arm * 4 * np.cos(0.3 * 4), 1e-6))
print(f"torque / (8 pi rate) = {torque / (8 * np.pi * 0.3):.6f}, tip at {height:.6f}")

# %% [markdown]
# ## A force: magnetic torque
#
# Each bead carries a magnetic moment $m$ along its director and feels the torque $m \times B$ in a
# field that turns at the rate $\omega$. A term with `oriented = True` makes the beads' directors
# part of the state.


# %%
class MagneticTorque(AbstractForce):
    """m p x B on each bead, with B at the angle `rate` t from x."""

    rotational: ClassVar[bool] = True  # the load holds torques
    oriented: ClassVar[bool] = True  # and reads directors
    strength: jax.Array = eqx.field(converter=number)  # m B [force length]
    rate: jax.Array = eqx.field(converter=number)  # omega [1/time]

    def load(self, t, state, scene):
        field = jnp.stack([jnp.cos(self.rate * t), jnp.sin(self.rate * t)])
        return jb.Load(torque=self.strength * cross(state.director, field))


# %% [markdown]
# A rigid rod of $N$ such beads that lags behind the field by $\phi$ obeys Adler's equation
# $$ \dot\phi = \omega - \omega_c \sin\phi, \qquad \omega_c = N m B / R. $$
# In a field at rest it turns like a compass needle in oil, $\tan(\theta/2) =
# \tan(\theta_0/2)\,e^{-\omega_c t}$. A field slower than $\omega_c$ takes the rod along; a faster
# one slips past it, and the rod turns at $\omega - \sqrt{\omega^2 - \omega_c^2}$ on average. All
# rates are one `vmap` over the scene's parameter, the times to save included: each run ends when
# the field has passed the rod once, or at $t = 60/\omega_c$.

# %%
critical = 1.0  # omega_c, the unit of time of this section
strength = critical * 167.347576 * 8 * np.pi / chain.beads


@jax.jit
@jax.vmap
def turned_rod(rate, start, ts):
    """Angle through which the rod has turned at each time [rad]."""
    scene = jb.Scene(
        chain,
        viscosity=1.0,
        constraints=[Gears(), EqualSpins()],
        forces=[MagneticTorque(strength, rate)],
    )
    direction = jnp.stack([jnp.cos(start), jnp.sin(start)])
    rod = jb.straight(chain, direction)
    rod = jb.State(rod.position, jnp.tile(direction, (chain.beads, 1)))
    bond = tangents(rollout(scene, rod, ts, substeps=4).states.position)[:, 0]
    change = jnp.arctan2(cross(bond[:-1], bond[1:])[:, 0], jnp.sum(bond[:-1] * bond[1:], axis=1))
    return jnp.pad(jnp.cumsum(change), (1, 0))


rates = np.array([0.0, 0.25, 0.5, 0.75, 0.9, 1.1, 1.25, 1.5, 2.0, 3.0])
start = np.where(rates == 0, 2.0, 0.0)
slips = rates > 1
beat = np.sqrt(np.abs(rates**2 - 1))
end = np.where(slips, 2 * np.pi / beat, 60.0)
ts = end[:, None] * np.linspace(0, 1, 121)
turned = np.asarray(turned_rod(rates, start, ts))

# A rod that follows is measured over the second half of its run; one that slips over the whole.
late = (turned[:, -1] - turned[:, 60]) / (end / 2)
mean_rate = np.where(slips, turned[:, -1] / end, late)
exact_rate = np.where(slips, rates - beat, rates)
worst = np.argmax(np.abs(mean_rate - exact_rate))
checks.append(("mean rate of the rod (worst)", mean_rate[worst], exact_rate[worst], 1e-5))
needle = 2.0 + turned[0]
exact = 2 * np.arctan(np.tan(1.0) * np.exp(-ts[0]))
worst = np.argmax(np.abs(needle - exact))
checks.append(("angle of the needle (worst)", needle[worst], exact[worst], 1e-5))

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained", dpi=110)
w = np.linspace(0, 3.2, 400)
theory = np.where(w > 1, w - np.sqrt(np.maximum(w**2 - 1, 0)), w)
left.plot(w, theory, color="0.6", label="Adler's equation")
left.plot(rates[1:], mean_rate[1:], "o", color="#31688e", label="ten beads")
left.set_xlabel(r"rate of the field $\omega / \omega_c$")
left.set_ylabel(r"mean rate of the rod $/\ \omega_c$")
left.legend(frameon=False)
colours = plt.colormaps["viridis"](np.linspace(0, 0.9, len(rates)))
for k in range(1, len(rates)):
    right.plot(ts[k], rates[k] * ts[k] - turned[k], color=colours[k], label=f"{rates[k]:g}")
right.set_xlim(0, 15)
right.set_xlabel(r"time $\omega_c t$")
right.set_ylabel(r"lag behind the field $\phi$ [rad]")
figure.legend(
    *right.get_legend_handles_labels(),
    title=r"$\omega/\omega_c$",
    loc="outside right",
    frameon=False,
)
plt.show()

# %% [markdown]
# A force that follows from an energy is shorter still: `AbstractPotential` asks for the energy
# alone and differentiates it. An optical trap pulls one bead to a place; a single bead returns to
# it as $\exp(-k t / 6 \pi \mu a)$.


# %%
class Trap(AbstractPotential):
    """k |r_0 - c|^2 / 2 for the first bead."""

    rotational: ClassVar[bool] = False
    stiffness: jax.Array = eqx.field(converter=number)  # k [force / length]
    centre: jax.Array = eqx.field(converter=number)  # c [length]

    def energy(self, t, state, scene):
        return 0.5 * self.stiffness * jnp.sum((state.position[0] - self.centre) ** 2)


single = jb.Chain(radius=1.0, fibres=1)


@jax.jit
@jax.value_and_grad
def trapped(stiffness):
    scene = jb.Scene(single, viscosity=1.0, forces=[Trap(stiffness, [0.0, 0.0])])
    start = jb.State(jnp.array([[1.0, 0.0]]))
    return rollout(scene, start, np.linspace(0, 2.0, 3), substeps=20).final.position[0, 0]


distance, slope = trapped(6 * np.pi)
checks.append(("distance from the trap at t = 2", distance, np.exp(-2), 1e-8))
checks.append(("... its derivative by log(k)", slope * 6 * np.pi, -2 * np.exp(-2), 1e-7))

# %% [markdown]
# ## A flow: a spreading vortex
#
# A flow is the velocity at *one* point; vorticity and strain rate at the beads come from
# differentiating it, and `Scene` maps it over them. The Lamb-Oseen vortex of circulation $\Gamma$
# solves the Navier-Stokes equations,
# $$ u_\theta = \frac{\Gamma}{2 \pi r} \left(1 - e^{-r^2/c^2}\right), \qquad c^2 = c_0^2 + 4 \nu t . $$


# %%
class Vortex(AbstractFlow):
    """Lamb-Oseen vortex about the origin."""

    circulation: jax.Array = eqx.field(converter=number)  # Gamma [length^2 / time]
    core: jax.Array = eqx.field(converter=number)  # c_0 [length]
    diffusivity: jax.Array = eqx.field(converter=number)  # nu [length^2 / time]

    def velocity(self, t, x):
        square = jnp.sum(x**2)
        s = square / (self.core**2 + 4 * self.diffusivity * t)
        rate = -jnp.expm1(-s) / jnp.where(square == 0, 1.0, square)
        return self.circulation / (2 * np.pi) * rate * jnp.stack([-x[1], x[0]])


# %% [markdown]
# A single bead moves with the fluid: it stays on a circle and turns by $\int u_\theta / r \, dt$.
# (The disturbance $C : E$ is what *other* beads do to a bead, so one bead has none.)

# %%
radius, end = 6.0, 20.0
vortex = Vortex(circulation=30.0, core=2.0, diffusivity=0.5)


@jax.jit
@jax.value_and_grad
def carried(circulation):
    flow = eqx.tree_at(lambda v: v.circulation, vortex, circulation)
    scene = jb.Scene(single, viscosity=1.0, flow=flow)
    start = jb.State(jnp.array([[radius, 0.0]]))
    x = rollout(scene, start, np.linspace(0, end, 3), substeps=50).final.position[0]
    return jnp.arctan2(x[1], x[0])


angle, slope = carried(number(30.0))
nodes, weights = np.polynomial.legendre.leggauss(40)
t = 0.5 * end * (nodes + 1)
core, s = 4.0 + 2 * t, radius**2 / (4.0 + 2 * t)
# A sphere feels (1 + a^2/6 lap) u, and lap u is the slope of the vorticity.
turned = 30.0 * (-np.expm1(-s) / (2 * np.pi * radius**2) - np.exp(-s) / (3 * np.pi * core**2))
turned = 0.5 * end * np.sum(weights * turned)
exact = (turned + np.pi) % (2 * np.pi) - np.pi
checks.append(("angle in the vortex", angle, exact, 1e-8))
checks.append(("... its derivative by Gamma", slope, turned / 30.0, 1e-8))

# %% [markdown]
# The same vortex winds up a flexible fibre of ten beads ($K_b = 20$), whose beads feel one another.

# %%
scene = jb.Scene(chain, viscosity=1.0, constraints=[Gears()], forces=[Bending(20.0)], flow=vortex)
start = jb.straight(chain, direction=[1.0, 0.0], centre=[12.0, 0.0])
run = jb.simulate(scene, start, np.linspace(0, 3 * end, 61), progress=False)
x = np.asarray(run.states.position)

figure, ax = plt.subplots(figsize=(4.6, 4.0), layout="constrained", dpi=110)
grid = np.linspace(-24, 24, 33)
points = np.stack(np.meshgrid(grid, grid), axis=-1)
u = jax.vmap(jax.vmap(lambda x: vortex.velocity(0.0, x)))(points)
ax.streamplot(grid, grid, u[..., 0], u[..., 1], color="0.85", linewidth=0.8, arrowsize=0.7)
for k in range(0, 61, 6):
    colour = plt.colormaps["viridis"](k / 60)
    ax.plot(x[k, :, 0], x[k, :, 1], "-o", color=colour, linewidth=1.5, markersize=2.5)
ax.set_aspect("equal")
ax.set_xlim(-18, 23)
ax.set_ylim(-18, 23)
ax.set_xlabel("$x/a$")
ax.set_ylabel("$y/a$")
scale = plt.Normalize(0, 3 * end)
figure.colorbar(plt.cm.ScalarMappable(scale, "viridis"), ax=ax, label="time $t$")
plt.show()

# %% [markdown]
# ## A mobility: drag along and across the fibre
#
# A mobility has a method `motion` that turns loads into velocities of the spheres of a
# configuration. It must be symmetric and positive definite. Resistive-force theory lets every bead
# feel only its own drag, $\zeta_\perp = 6 \pi \mu a$ across the fibre and $\zeta_\perp / q$ along
# it:
# $$ v_i = \frac{1}{\zeta_\perp} \left[ I + (q - 1)\, e_i e_i \right] F_i . $$


# %%
class ResistiveForce(AbstractMobility):
    """Resistive-force theory for one fibre."""

    ratio: jax.Array = eqx.field(converter=number)  # q, friction across over friction along

    def motion(self, configuration, load):
        force = load.force
        if force is not None:
            e = tangents(configuration.position)
            e = unit(jnp.concatenate([e[:1], e[:-1] + e[1:], e[-1:]]))  # at each bead
            along = jnp.sum(e * force, axis=1, keepdims=True) * e
            force = force + (self.ratio - 1) * along
        return FreeDraining().motion(configuration, jb.Load(force, load.torque))


# %% [markdown]
# A rod whose axis makes the angle $\alpha$ with its weight does not fall straight down. Its
# velocity is off the vertical by
# $$ \tan\delta = \frac{(q - 1) \sin\alpha \cos\alpha}{1 + (q - 1) \cos^2\alpha}, \qquad
# \max \delta = \arcsin\frac{q - 1}{q + 1}, $$
# at $\cos 2\alpha = -(q - 1)/(q + 1)$. For $q = 2$ this is $19.471^\circ$. A rigid rod with the
# full hydrodynamics obeys the same formula with its own $q$; ten beads have $3.994842/2.864486 =
# 1.3946$ (independent computation). That is far from the slender limit, $q = 2$.


# %%
def drift(tilt, mobility):
    """Angle between velocity and weight of a rod that is tilted by `tilt` from its weight [rad]."""
    scene = jb.Scene(
        chain,
        viscosity=1.0,
        mobility=mobility,
        constraints=[Gears(), EqualSpins()],
        forces=[Weight([0.0, -1.0])],
    )
    rod = jb.straight(chain, jnp.stack([jnp.sin(tilt), -jnp.cos(tilt)]))
    v = jnp.mean(jb.dynamics.motion(0.0, rod, scene).velocity, axis=0)
    return jnp.arctan2(v[0], -v[1])


q_beads = 3.994842 / 2.864486
tilts = np.linspace(0, np.pi / 2, 91)
drifts = {}
for name, mobility, q in (("local drag", ResistiveForce(2.0), 2.0), ("RPY", RPY(), q_beads)):
    steepest = 0.5 * np.arccos(-(q - 1) / (q + 1))
    *drifts[name], largest = jax.jit(jax.vmap(drift, (0, None)))(
        np.append(tilts, steepest), mobility
    )
    checks.append(
        (
            f"largest drift [deg], {name}",
            np.degrees(largest),
            np.degrees(np.arcsin((q - 1) / (q + 1))),
            1e-5,
        )
    )

# M column by column: symmetric and positive definite.
curved = jb.State(x[30])
operator = ResistiveForce(2.0).operator(jb.Configuration(curved.position, 1.0, 1.0))
columns = [
    operator.motion(jb.Load(f, jnp.zeros((10, 1)))).velocity for f in np.eye(20).reshape(20, 10, 2)
]
matrix = np.reshape(columns, (20, 20))
checks.append(("asymmetry of M, bent fibre", np.abs(matrix - matrix.T).max(), 0.0, 1e-15))
checks.append(
    ("smallest eigenvalue of M x 6 pi", 6 * np.pi * np.linalg.eigvalsh(matrix)[0], 1.0, 1e-12)
)

# %%
figure, ax = plt.subplots(figsize=(4.8, 3.4), layout="constrained", dpi=110)
for q, colour in ((2.0, "#31688e"), (q_beads, "#35b779")):
    s, c = np.sin(tilts), np.cos(tilts)
    theory = np.arctan((q - 1) * s * c / (1 + (q - 1) * c**2))
    ax.plot(np.degrees(tilts), np.degrees(theory), color=colour, label=f"formula, $q = {q:.4g}$")
for name, colour, marker in (("local drag", "#31688e", "o"), ("RPY", "#35b779", "s")):
    ax.plot(
        np.degrees(tilts)[::6],
        np.degrees(drifts[name])[::6],
        marker,
        color=colour,
        label=f"{name}, ten beads",
        markersize=4,
    )
ax.set_xlabel(r"tilt from the vertical $\alpha$ [degrees]")
ax.set_ylabel(r"drift $\delta$ [degrees]")
ax.legend(frameon=False, fontsize=8)
plt.show()

# %% [markdown]
# ## All of them at once, and the gradient of the whole
#
# A flexible, magnetic fibre in the vortex, with its first bead in a trap, its middle bond turning
# at a given rate, under resistive-force drag. The gradient of the last bead's final height with
# respect to one number of each term, in one reverse pass, against central differences.


# %%
def last_height(parameters):
    rate, strength, stiffness, circulation, ratio, rigidity = parameters
    scene = jb.Scene(
        chain,
        viscosity=1.0,
        mobility=ResistiveForce(ratio),
        constraints=[Gears(), Turning(rate, bond=4)],
        forces=[MagneticTorque(strength, 0.7), Trap(stiffness, [-8.0, 1.0]), Bending(rigidity)],
        flow=Vortex(circulation, 2.0, 0.5),
    )
    start = jb.straight(chain, direction=[1.0, 0.0], centre=[1.0, 0.0])
    start = jb.State(start.position, jnp.tile(jnp.array([1.0, 0.0]), (chain.beads, 1)))
    return rollout(scene, start, np.linspace(0, 2.0, 3), substeps=20).final.position[-1, 1]


names = ("rate", "m B", "k", "Gamma", "q", "K_b")
parameters = jnp.array([0.3, 5.0, 4.0, 30.0, 2.0, 20.0])
gradient = jax.jit(jax.grad(last_height))(parameters)
step = 1e-4 * parameters
shifted = jnp.concatenate([parameters + jnp.diag(step), parameters - jnp.diag(step)])
heights = jax.jit(jax.vmap(last_height))(shifted)
differences = (heights[:6] - heights[6:]) / (2 * step)
for name, g, d in zip(names, gradient, differences, strict=True):
    checks.append((f"d(height)/d({name})", g, d, 1e-6 * abs(float(d))))

# %% [markdown]
# ## Check

# %%
print(f"{'quantity':34s} {'measured':>13s} {'reference':>13s} {'difference':>11s} {'allowed':>8s}")
for name, measured, reference, allowed in checks:
    off = abs(float(measured) - float(reference))
    print(f"{name:34s} {measured:13.8g} {reference:13.8g} {off:11.1e} {allowed:8.0e}")
for name, measured, reference, allowed in checks:
    assert abs(float(measured) - float(reference)) <= allowed, name
