# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3 (ipykernel)
#     language: python
#     name: python3
# ---

# %% [markdown]
# # An efficient swimming filament from a random start
#
# A free filament bends its joints periodically. Which stroke swims most efficiently? Lighthill's
# efficiency is
#
# $$\eta = \gamma_\parallel V^2 / P ,$$
#
# with $V$ the mean speed, $P$ the mean power and $\gamma_\parallel$ the friction of the straight
# filament along its axis. For small strokes $V$ and $P$ are both quadratic in the size of the
# stroke, so $\eta$ is too, and a size has to be fixed: that of the curvature $\kappa$, averaged
# over the joints and the period, $\langle (\kappa L)^2 \rangle = \sigma^2$. What is sought is the
# largest $\eta/\sigma^2$ for small $\sigma$.
#
# The curvature is a Fourier series with four cosines along the filament and one harmonic in time,
#
# $$\kappa(s, t) = \mathrm{Re} \sum_{m=0}^{3} z_m \cos\frac{m \pi s}{L}\, e^{2 \pi i f t} ,$$
#
# eight numbers that start at random. Nothing in it says that the stroke should be a wave. Ten
# beads that roll on one another; units: bead radius $a = 1$, viscosity $\mu = 1$, frequency $f =
# 1$.

# %%
import jax

jax.config.update("jax_enable_x64", True)
import diffrax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
import scipy.linalg
import scipy.optimize

import jaxbeads as jb
from jaxbeads.actuation import FourierCurvature
from jaxbeads.constraint import AbstractConstraint, Gears
from jaxbeads.force import Bending
from jaxbeads.geometry import bonds, cross
from jaxbeads.observables import power, rigid_resistance

BEADS, MODES, SIZE = 10, 4, 0.1
JOINTS = BEADS - 2
chain = jb.Chain(1.0, BEADS)
length = float(chain.length[0])
straight = jb.straight(chain, [1.0, 0.0])
checks = []  # rows of the table at the end: quantity, measured, reference, allowed difference

# %% [markdown]
# ## The filament
#
# The stroke is prescribed first: joints of any stiffness can be made to follow a given stroke,
# and the fluid feels the stroke only. A constraint of our own makes neighbouring bonds turn
# against each other at the rate of the prescribed curvature; how the filament as a whole moves
# and turns is left to the fluid. There is nothing stiff in that, and 16 equal steps of an
# explicit method make a period. (A filament with elastic joints that are driven by a preferred
# curvature comes at the end.)


# %%
class DrivenJoints(AbstractConstraint):
    """The angle between neighbouring bonds follows a law of curvature."""

    rotational = False
    curvature: FourierCurvature

    def slip(self, t, state, motion, chain):
        d = bonds(state.position)
        turning = cross(d, bonds(motion.velocity))[:, 0] / (d * d).sum(axis=1)
        change = jax.jvp(lambda t: joint_angles(self.curvature, t), (t,), (jnp.ones_like(t),))
        return turning[1:] - turning[:-1] - change[1]


arclength = 2.0 * np.arange(1, BEADS - 1) + 1.0  # of the joints


def joint_angles(curvature, t):
    """Angle between the two bonds at each joint [rad]; a bond is 2 long."""
    return 2.0 * curvature(t, arclength, length)


def bent(angles, slope=None):
    """The filament with these joint angles, along x in the mean, or from a first slope."""
    turned = jnp.concatenate([jnp.zeros(1), jnp.cumsum(angles)])
    turned = turned - turned.mean() if slope is None else turned + slope
    steps = 2.0 * jnp.stack([jnp.cos(turned), jnp.sin(turned)], axis=1)
    return jb.State(jnp.concatenate([jnp.zeros((1, 2)), jnp.cumsum(steps, axis=0)]))


def law(z):
    """First-harmonic curvature with the complex amplitudes z."""
    still = jnp.zeros(len(z))
    return FourierCurvature(
        cosine=jnp.stack([still, jnp.real(z)], axis=1),
        sine=jnp.stack([still, -jnp.imag(z)], axis=1),
        frequency=1.0,
    )


cosines = np.cos(np.pi * np.outer(arclength / length, np.arange(JOINTS)))
ts = np.linspace(0.0, 1.0, 17)


def swim(z, size):
    """Scene and one period of the stroke with the amplitudes z, brought to a size."""
    kappa = cosines[:, : len(z)] @ z
    scaled = size * z / jnp.sqrt(jnp.mean(jnp.abs(kappa) ** 2) / 2) / length
    joints = DrivenJoints(law(scaled))
    scene = jb.Scene(chain, 1.0, constraints=[Gears(), joints])
    start = bent(joint_angles(joints.curvature, jnp.zeros(())))
    return scene, jb.rollout(scene, start, ts, solver=diffrax.Tsit5(), substeps=1)


def loss(numbers):
    """Minus the logarithm of efficiency over size squared."""
    scene, period = swim(numbers[0] + 1j * numbers[1], SIZE)
    return -jnp.log(jb.objectives.efficiency(period, scene) / SIZE**2)


# %% [markdown]
# ## From random strokes
#
# Four random starts are followed side by side. The logarithm keeps the gradient in scale and
# keeps away from strokes that do not swim, at which the efficiency has a minimum.

# %%
starts = np.random.default_rng(0).normal(size=(4, 2, MODES))
best = jb.optimise(
    loss, starts, many=True, optimiser=optax.lbfgs(1.0, linesearch=None), progress=False
)
reached = np.exp(-np.asarray(best.loss))
found = np.asarray(best.values[0, 0] + 1j * best.values[0, 1])
print(f"{len(best.history.loss)} steps, {best.status}")
print("eta/sigma^2 at the starts:", np.exp(-best.history.loss[0]))
print("and at the end:           ", reached)

# %% [markdown]
# ## The best stroke from an eigenvalue problem
#
# Near the straight shape all this can be had without following any motion. The velocity along the
# axis is, to second order, a bilinear form of the bonds' slopes and of the rates of the joint
# angles; the power is a quadratic form of the rates. They are measured on single instants, by one
# shape and one rate at a time. With $\phi$ the complex amplitudes of the joint angles this gives
#
# $$V = \phi^\dagger Q \phi, \qquad P = \phi^\dagger R \phi, \qquad \sigma^2 = \phi^\dagger S \phi .$$
#
# Of the bilinear form only the antisymmetric part is left in the mean, the other one is the
# derivative of something periodic: $Q$ is imaginary and antisymmetric, $R$ is real and symmetric.
# A stroke whose joints move in step ($\phi$ real) gets nowhere; reversing time, $\phi \to
# \phi^*$, reverses $V$ and leaves $P$. Since $V^2/P$ is the maximum over $\nu$ of $2 \nu V -
# \nu^2 P$,
#
# $$\max_\phi \frac{V^2}{P} \bigg|_{\sigma = 1} = \max_\nu \;
# \lambda_\mathrm{max}\!\left( 2 \nu Q - \nu^2 R;\; S \right) ,$$
#
# the largest eigenvalue of a Hermitian problem, maximised over one number: the best of all small
# strokes; no start is needed.


# %%
def instant(slopes, rates):
    """Velocity along x, turning rates of the bonds, and power."""
    amplitudes = jnp.linalg.solve(cosines, rates) / 2.0 / (2 * np.pi)
    scene = jb.Scene(chain, 1.0, constraints=[Gears(), DrivenJoints(law(-1j * amplitudes))])
    state = bent(jnp.diff(slopes), slopes[0])
    moved = jb.dynamics.motion(0.0, state, scene).velocity
    d = bonds(state.position)
    turning = cross(d, bonds(moved))[:, 0] / 4.0
    return moved[:, 0].mean(), turning, power(0.0, state, scene)


small, slopes, rates = 1e-4, np.eye(BEADS - 1), np.eye(JOINTS)
asked = [(sign * small * a, b) for sign in (1, -1) for a in slopes for b in rates]
asked += [(0 * slopes[0], a + b) for a in rates for b in rates]
asked += [(0 * slopes[0], a) for a in rates]
answers = jax.jit(jax.vmap(instant))(*(np.array(x) for x in zip(*asked, strict=True)))
velocity, turning, work = (np.asarray(x) for x in answers)
tilted, summed = 2 * (BEADS - 1) * JOINTS, JOINTS**2
bilinear = velocity[:tilted].reshape(2, BEADS - 1, JOINTS)
bilinear = (bilinear[0] - bilinear[1]) / (2 * small)  # velocity = slopes . bilinear . rates
follows = turning[tilted + summed :].T  # the slopes of the bonds follow the joint angles
alone = work[tilted + summed :]
drag = (work[tilted : tilted + summed].reshape(JOINTS, JOINTS) - alone - alone[:, None]) / 2

omega = 2 * np.pi
mixed = follows.T @ bilinear
Q = 1j * omega / 4 * (mixed - mixed.T)
R = omega**2 / 2 * drag
S = np.eye(JOINTS) * (length / 2) ** 2 / (2 * JOINTS)
friction = float(rigid_resistance(straight.position, chain)[0, 0])


def best_stroke(basis):
    """Largest gamma V^2/(P sigma^2) of all strokes in a basis of joint angles, and the stroke."""
    q, r, s = (basis.T @ form @ basis for form in (Q, R, S))

    def top(nu):
        return scipy.linalg.eigh(2 * nu * q - nu**2 * r, s)

    grid = np.geomspace(1e-6, 1.0, 200)
    at = int(np.argmax([top(nu)[0][-1] for nu in grid]))
    bracket = tuple(grid[at - 1 : at + 2])
    nu = scipy.optimize.minimize_scalar(lambda nu: -top(nu)[0][-1], bracket=bracket, tol=1e-12).x
    values, vectors = top(nu)
    return friction * values[-1], basis @ vectors[:, -1]


def by_forms(phi):
    """Efficiency over size squared of a stroke."""
    v, p, s = ((phi.conj() @ form @ phi).real for form in (Q, R, S))
    return friction * v**2 / (p * s)


highest, eigenstroke = best_stroke(cosines[:, :MODES])
highest_of_all, stroke_of_all = best_stroke(np.eye(JOINTS))
phi = 2 * cosines[:, :MODES] @ found  # joint angles of the optimum, but for their size


def overlap(one, other):
    """1 for the same stroke, begun at any time."""
    return abs(one.conj() @ other) / np.linalg.norm(one) / np.linalg.norm(other)


same = max(overlap(eigenstroke, phi), overlap(eigenstroke.conj(), phi))
waves = [np.exp(1j * k * arclength) for k in np.linspace(0.05, 3, 400) * 2 * np.pi / length]
pure = [by_forms(wave) for wave in waves]
print(f"eta/sigma^2: eigenvalue {highest:.6e}, optimised {reached.max():.6e}")
print(f"overlap of the strokes {same:.8f}")
alike = np.sign(np.imag(Q[np.triu_indices(JOINTS, 1)]))
print(f"{np.sum(alike == np.sign(alike.sum()))} of {len(alike)} pairs of joints have one sign in Q")
gains = np.real(phi.conj()[:, None] * Q * phi)
gains = [2 * np.trace(gains, apart) / gains.sum() for apart in range(1, JOINTS)]
print("share of pairs in V, 1, 2, ... joints apart:", np.round(gains, 3))
checks.append(("pairs of joints with one sign in Q", np.sum(alike == np.sign(alike.sum())), 26, 0))
best_wave = np.linspace(0.05, 3, 400)[int(np.argmax(pure))]
print(f"best pure wave {max(pure):.4e}, {best_wave:.2f} wavelengths on the filament; ", end="")
print(f"all joints free of one another {highest_of_all:.4e}")
checks.append(("starts that reach the optimum", np.sum(reached / reached.max() > 1 - 1e-6), 4, 0))
checks.append(("optimum: overlap with the eigenvector", same, 1.0, 1e-6))

# %% [markdown]
# The gradient has found the eigenvector from four random starts. What is left between the two
# efficiencies is the size of the stroke in the run, $\sigma = 0.1$, which the eigenvalue takes as
# zero; it must fall like $\sigma^2$.
#
# ## A wave, and its reverse
#
# The optimum, smaller and larger; the same stroke in reverse, and its mirror image (ends
# exchanged).

# %%
sizes = np.array([0.05, 0.1, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0])
pure_wave = np.linalg.solve(cosines, waves[int(np.argmax(pure))])
all_joints = np.linalg.solve(cosines, stroke_of_all)
padded = np.pad(found, (0, JOINTS - MODES))
strokes = [(padded, size) for size in sizes] + [(pure_wave, size) for size in sizes]
strokes += [(padded.conj(), SIZE), (padded * (-1.0) ** np.arange(JOINTS), SIZE), (all_joints, SIZE)]


@jax.jit
@jax.vmap
def measure(z, size):
    """Displacement, efficiency and shapes of a stroke over a period."""
    scene, period = swim(z, size)
    step = jb.objectives.displacement(period)
    return step, jb.objectives.efficiency(period, scene), period.states.position


measured = measure(*(jnp.array(x) for x in zip(*strokes, strict=True)))
step, efficiency, shapes = (np.asarray(x) for x in measured)
count = len(sizes)
here, back, mirror, free = 1, 2 * count, 2 * count + 1, 2 * count + 2
small_ratio = efficiency[:2] / sizes[:2] ** 2 / highest
limit = (4 * small_ratio[0] - small_ratio[1]) / 3  # without the term in sigma^2
phase = np.unwrap(np.angle(phi))
turns = np.diff(phase) * np.sign(phase[-1] - phase[0])
direction = np.sign(phase[0] - phase[-1])  # in which the crests run: +1 to larger s
print(f"phase along the filament, radians from joint to joint: {turns.round(3)}")
print(f"crests run to {'larger' if direction > 0 else 'smaller'} s, ", end="")
print(f"the filament moves by {step[here, 0] / length:+.3e} L a period")
print(f"in reverse {step[back, 0] / length:+.3e} L, mirrored {step[mirror, 0] / length:+.3e} L")
for k in range(count):
    print(f"sigma = {sizes[k]:4.2f}: efficiency {efficiency[k]:.3e}, ", end="")
    print(f"best pure wave {efficiency[count + k]:.3e}")
checks.append(("eta/sigma^2 over eigenvalue, sigma = 0.1", small_ratio[1], 1.0, SIZE**2))
checks.append(("... extrapolated to sigma = 0", limit, 1.0, 1e-5))
checks.append(("in reverse: displacement", step[back, 0] / step[here, 0], -1.0, 1e-6))
checks.append(("in reverse: efficiency", efficiency[back] / efficiency[here], 1.0, 1e-6))
checks.append(("mirrored: displacement", step[mirror, 0] / step[here, 0], -1.0, 1e-6))
checks.append(("mirrored: efficiency", efficiency[mirror] / efficiency[here], 1.0, 1e-6))
checks.append(("phase runs one way along it (1: yes)", turns.min() > 0.1, 1, 0))
checks.append(("moves against its wave (1: yes)", step[here, 0] * direction < 0, 1, 0))
checks.append(("no better pure wave (1: yes)", max(pure) < highest, 1, 0))

# %% [markdown]
# ## An elastic filament with this stroke
#
# A filament with elastic joints is driven by a preferred curvature $\kappa_0$: fluid and
# elasticity turn that into a stroke. With $2 \pi f \mu L^4 / K_b = 22.6$, as for a nematode, we
# ask for the $\kappa_0$ that gives the optimum. Near the straight shape the slopes $\theta$ of
# the bonds obey $\dot\theta = A \theta + C \kappa_0$; at the frequency $f$ the joints' part of
# this is solved for $\kappa_0$. The filament starts straight, and is measured in its third
# period.

# %%
rigidity = 2 * np.pi * length**4 / 22.6


def elastic(z):
    """The filament with elastic joints that is driven by a preferred curvature."""
    return jb.Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(rigidity, law(z))])


@jax.jit
@jax.vmap
def bond_rates(slopes, curvature):
    """Rates at which the bonds turn, with a preferred curvature at the joints."""
    forces = [Bending(rigidity, curvature)]
    scene = jb.Scene(chain, 1.0, constraints=[Gears()], forces=forces)
    state = bent(jnp.diff(slopes), slopes[0])
    d = bonds(state.position)
    return cross(d, bonds(jb.dynamics.motion(0.0, state, scene).velocity))[:, 0] / 4.0


one_each = small * np.eye(BEADS - 1 + JOINTS)
linear = np.asarray(bond_rates(one_each[:, : BEADS - 1], one_each[:, BEADS - 1 :])).T / small
A, C = linear[:, : BEADS - 1], linear[:, BEADS - 1 :]
wanted = np.asarray(SIZE * phi / np.sqrt((phi.conj() @ S @ phi).real))  # joint angles
theta = follows @ wanted
preferred = np.linalg.solve(np.diff(C, axis=0), np.diff(1j * omega * theta - A @ theta, axis=0))
scene = elastic(np.linalg.solve(cosines, preferred))
run = jb.simulate(scene, straight, np.linspace(0, 3, 97), tolerance=1e-9, progress=False)
period = jb.Solution(run.ts[64:], jax.tree.map(lambda x: x[64:], run.states), run.steps, run.code)
elastic_efficiency = float(jax.jit(jb.objectives.efficiency)(period, scene))
bond = np.diff(np.asarray(period.states.position), axis=1)
angles = np.diff(np.unwrap(np.arctan2(bond[..., 1], bond[..., 0])), axis=1)
harmonic = 2 * np.mean(angles[:-1] * np.exp(-1j * omega * np.asarray(period.ts[:-1]))[:, None], 0)
driven = np.abs(preferred / wanted * 2)  # a joint angle is twice the curvature
print(f"{int(run.steps)} steps; preferred curvature over that of the stroke: {driven.round(3)}")
print(f"eta/sigma^2 {elastic_efficiency / SIZE**2:.5e}, ", end="")
print(f"prescribed stroke {efficiency[here] / SIZE**2:.5e}")


def ellipse(x, y):
    """Conic through the points by least squares, scaled to 1; its largest error."""
    x, y = x / np.abs(x).max(), y / np.abs(y).max()
    columns = np.stack([x**2, x * y, y**2, x, y], axis=1)
    conic = np.linalg.lstsq(columns, np.ones(len(x)), rcond=None)[0]
    assert conic[1] ** 2 < 4 * conic[0] * conic[2], "an ellipse, not a hyperbola"
    return np.abs(columns @ conic - 1).max()


def area(x, y):
    """Area within a closed loop over that of the circle of the same amplitudes."""
    return np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) / 2 / (np.pi * np.abs(x).max() * np.abs(y).max())


neighbours = [(angles[:, j], angles[:, j + 1]) for j in range(JOINTS - 1)]
roundness = max(ellipse(x, y) for x, y in neighbours)
areas = direction * np.array([area(x, y) for x, y in neighbours])
print("areas of the loops of neighbouring joints, over a circle's:", areas.round(3))
checks.append(("elastic filament: efficiency", elastic_efficiency / efficiency[here], 1.0, SIZE**2))
deviation = np.abs(harmonic - wanted).max() / np.abs(wanted).max()
checks.append(("elastic filament: joint angles, error", deviation, 0.0, SIZE**2))
checks.append(("joint angles: error of the ellipses", roundness, 0.0, SIZE**2))
# A polygon of 32 corners is 0.6 % smaller than its ellipse.
checks.append(("joint angles: smallest area = sin(phase)", areas.min(), np.sin(turns.min()), 5e-3))

# %%
figure, axes = plt.subplots(1, 3, figsize=(12.5, 3.9), layout="constrained", dpi=110)
colours = ["#440154", "#31688e", "#35b779", "#b5a000"]
history = np.exp(-best.history.loss)
for k, colour in enumerate(colours):
    axes[0].semilogy(history[:, k], color=colour, label=f"start {k + 1}")
axes[0].axhline(highest, color="0.4", linestyle=":", label="eigenvalue")
axes[0].set(xlabel="step of the optimiser", ylabel=r"efficiency $\eta/\sigma^2$")
axes[0].legend(frameon=False, loc="lower right")
begun = [2 * cosines[:, :MODES] @ (z[0] + 1j * z[1]) for z in starts]
for random, colour in zip(begun, colours, strict=True):
    line = np.unwrap(np.angle(random))
    axes[1].plot(arclength / length, (line - line[0]) / np.pi, color=colour, linewidth=1)
axes[1].plot([], [], color="0.5", linewidth=1, label="random starts")
axes[1].plot(arclength / length, (phase - phase[0]) / np.pi, "o-", color="#d62728", label="optimum")
axes[1].set(xlabel="arclength $s/L$", ylabel=r"phase of the curvature over $\pi$")
axes[1].legend(frameon=False)
degrees = np.degrees(angles)
around = np.exp(1j * omega * np.linspace(0, 1, 101))
for j, colour in ((1, "#440154"), (2, "#31688e"), (3, "#35b779")):
    axes[2].plot(degrees[:, 0], degrees[:, j], ".", color=colour, label=f"joints 1 and {j + 1}")
    pair = [np.degrees(np.real(wanted[k] * around)) for k in (0, j)]
    axes[2].plot(*pair, color=colour, linewidth=1)
axes[2].set(xlabel="angle of joint 1 (degrees)", ylabel="angle of another joint (degrees)")
axes[2].legend(frameon=False, fontsize=8, loc="upper right", bbox_to_anchor=(1.0, 1.16), ncols=3)
plt.show()

# %% [markdown]
# Left: efficiency in the course of the optimisation. Middle: where along the filament the
# curvature lags; the phases of random strokes turn back, the optimum's runs one way. Right: joint
# angles of the elastic filament (points, its third period) against one another, with the ellipses
# that were asked for.
#
# ## How good is a pure wave, and how large should the stroke be?

# %%
figure, axes = plt.subplots(1, 3, figsize=(12.5, 3.7), layout="constrained", dpi=110)
show = int(np.flatnonzero(sizes == 3.0)[0])
viridis = plt.colormaps["viridis"]
for k in range(0, 17, 2):
    axes[0].plot(*(shapes[show, k] / length).T, color=viridis(k / 16), linewidth=1.6)
scale = plt.cm.ScalarMappable(plt.Normalize(0, 1), "viridis")
figure.colorbar(scale, ax=axes[0], label="part of the period", shrink=0.8)
axes[0].set_aspect("equal", adjustable="datalim")
axes[0].set(xlabel="$x/L$", ylabel="$y/L$")
axes[0].set_title(r"optimum of small strokes at $\sigma = 3$", fontsize=10)
lengths = np.linspace(0.05, 3, 400)
axes[1].plot(lengths, np.array(pure) * 1e4, color="#31688e", label="pure wave")
axes[1].axhline(highest * 1e4, color="#d62728", label="optimum, four cosines")
axes[1].axhline(highest_of_all * 1e4, color="0.5", linestyle=":", label="all joints free")
axes[1].set(xlabel="wavelengths on the filament", ylabel=r"efficiency $10^4\, \eta/\sigma^2$")
axes[1].set_ylim(0, 9)
axes[1].legend(frameon=False)
axes[2].plot(
    sizes, 100 * efficiency[:count], "o-", color="#d62728", label="optimum of small strokes"
)
axes[2].plot(
    sizes, 100 * efficiency[count : 2 * count], "s-", color="#31688e", label="best pure wave"
)
fine = np.linspace(0, 3, 50)
axes[2].plot(fine, 100 * highest * fine**2, color="0.5", linestyle=":", label="small strokes")
axes[2].set(xlabel=r"size of the stroke $\sigma$", ylabel=r"efficiency $\eta$ (%)", ylim=(0, 0.3))
axes[2].legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
plt.show()

# %% [markdown]
# **Why a wave.** Two joints displace the filament only if one lags behind the other: the loop
# that their angles trace must enclose an area, as for the scallop. In what sense the loop must be
# run through is the sign of their entry in $Q$, and that is the same for all pairs but the
# outermost two neighbours at either end. Every joint should therefore lag behind the one before:
# a wave. Pairs two to four joints apart gain most. Joints further apart than half a wave would
# work against the rest, so that the wave is not shorter than the filament.
#
# The filament moves against its crests, because friction across the bonds is larger than along.
#
# **What the ends do.** A pure wave with 0.93 wavelengths on the filament comes within 6 % of the
# optimum. The optimum bends its end joints least, by 0.6 of the largest angle. With all joints
# free of one another 9 % more are to be had, but by a stroke that alternates from joint to joint:
# a property of ten beads, not of a filament.
#
# **Large strokes.** The optimum of small strokes stays ahead of the best pure wave up to $\sigma
# = 2$ and falls behind at 3, near which both are most efficient. For a stroke of that size one
# would optimise at that size.

# %% [markdown]
# ## Check

# %%
print(f"{'quantity':42s} {'measured':>12s} {'reference':>10s} {'difference':>11s} {'allowed':>8s}")
for name, measured, reference, allowed in checks:
    off = abs(float(measured) - float(reference))
    print(f"{name:42s} {float(measured):12.6g} {float(reference):10.6g} {off:11.1e} {allowed:8.0e}")
for name, measured, reference, allowed in checks:
    assert abs(float(measured) - float(reference)) <= allowed, name
