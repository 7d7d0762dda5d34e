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
# # Swimmers
#
# Section 3.5 of the paper lets chains of Gears swim by bending moments of their own. Here: a
# nematode, two nematodes side by side, a spiral swimmer in space, and three linked spheres, whose
# displacement is known exactly in a limit. A swimmer is free: no force and no torque act on it as a
# whole.
#
# The unit of time is a period, $f = 1$; lengths are given over $L = 2 a N$ or over the bead radius
# $a$. Dimensionless frequency: $2 \pi f \mu L^4 / K_b$, where $K_b$ is the bending rigidity and
# $\mu$ the viscosity.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxbeads as jb
import jaxbeads.plot
from jaxbeads import scenes
from jaxbeads.scenes.case import SAMPLES  # save times in a period

jax.config.update("jax_enable_x64", True)
viridis = plt.colormaps["viridis"]
checks = []  # rows of the table at the end: quantity, measured, reference, allowed difference

# %% [markdown]
# ## A nematode
#
# The fibre prefers the curvature of a travelling wave,
# $$ \kappa_0(s, t) = -A(s) \sin(k s - 2 \pi f t), \qquad m = K_b (\kappa - \kappa_0), $$
# with $A = 8.25/L$ from the head ($s = 0$) to the middle, falling to zero at the tail, $k = 1.5 \pi
# / L$, and $2 \pi f \mu L^4 / K_b = 22.6$ (Majmudar et al., J. R. Soc. Interface 9 (2012) 1809).
# Its actual curvature is what elasticity and the fluid make of that. The run starts straight and
# ends when the shape repeats itself. An independent computation gives $V/(fL) = 0.0746$ for 15
# beads. The efficiency is Lighthill's: the power that tows the straight fibre along its axis at the
# swimming speed, over the mean power of the stroke.

# %%
nematode = scenes.nematode(15)
worm = nematode.simulate(progress=False)
chain = nematode.scene.chain
length = float(chain.length[0])
x = np.asarray(worm.states.position) / length
centre = x.mean(axis=1)
step = centre[-1] - centre[-1 - SAMPLES]  # of the last period
speed = np.linalg.norm(step)
efficiency = float(jb.objectives.efficiency(scenes.last_period(worm), nematode.scene))
ahead = np.mean(x[-SAMPLES:, 0] - x[-SAMPLES:, -1], axis=0)  # from tail to head
head_first = step @ ahead / (speed * np.linalg.norm(ahead))
checks.append(("nematode: V/(fL), 15 beads", speed, 0.0746, 1e-4))
checks.append(("nematode: head leads, cosine", head_first, 1.0, 0.01))
print(f"V/(fL) = {speed:.5f}, efficiency {efficiency:.3%}, {float(worm.ts[-1]):.0f} periods")

# %% [markdown]
# It moves towards its head, against its wave. Left: shapes over the last period, the head marked.
# Middle: the path of the centre from the start, with two small loops in each period. Right: the
# wave of curvature runs from head to tail.

# %%
figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.4), layout="constrained", dpi=110)
for k in range(0, SAMPLES, 5):
    now = x[-1 - SAMPLES + k]
    axes[0].plot(*now.T, color=viridis(k / SAMPLES), linewidth=1.6)
    axes[0].plot(*now[0], "o", color=viridis(k / SAMPLES), markersize=4)
scale = plt.cm.ScalarMappable(plt.Normalize(0, 1), "viridis")
figure.colorbar(scale, ax=axes[0], label="part of the period", shrink=0.8)
axes[1].plot(*centre.T, color="#31688e")
axes[1].plot(*centre[::SAMPLES].T, "o", color="#31688e", markersize=4, label="whole periods")
axes[1].legend(frameon=False)
for ax in axes[:2]:
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("$x/L$")
    ax.set_ylabel("$y/L$")
jaxbeads.plot.kymograph(worm, chain, axes=axes[2])
axes[2].set_ylabel("arclength $s/L$ from the head")
axes[2].set_xlabel("time (periods)")
plt.show()

# %% [markdown]
# **Number of beads.** $N$ is at once the aspect ratio of the worm, $L/2a$, and its resolution: the
# frictions along and across a short chain differ little, so it is slow, and what changes with $N$
# is the worm itself. The others than 15 are measured in their second period, in which the swimming
# is already periodic.

# %%
numbers, speeds = [10, 15, 20], []
for beads in numbers:
    case = scenes.nematode(beads)
    case = case._replace(ts=case.ts[: 2 * SAMPLES + 1], until=None)
    run = worm if beads == 15 else case.simulate(progress=False)
    speeds.append(float(jb.objectives.distance(scenes.last_period(run))) / (2 * beads))
second = np.linalg.norm(centre[2 * SAMPLES] - centre[SAMPLES])
checks.append(("... in the second period", second, speed, 1e-5))
print({n: round(v, 5) for n, v in zip(numbers, speeds, strict=True)})

# %% [markdown]
# ## Two nematodes
#
# Two of them, side by side in the plane of their beat, at the distance $d$ of their axes, with
# waves in phase and half a period apart. $V$ is the displacement of their common centre along their
# first direction in the third period from a straight start, $V_0$ that of one alone. At $d = L$ an
# independent computation gives $V/V_0 = 1.015$ in phase and $1.040$ in antiphase.
#
# Below about $0.45\,L$ the worms touch. The scene's `Contact` force then keeps them apart: the
# smallest gap between surfaces of the two is measured over the whole run, and compared with a run
# without that force (its strength set to zero, which is the same compiled program).


# %%
def advance(solution):
    """Displacement of the centre along x in the third period [length]."""
    centre = np.asarray(solution.states.position)[: 3 * SAMPLES + 1, :, 0].mean(axis=1)
    return centre[3 * SAMPLES] - centre[2 * SAMPLES]


def smallest_gap(solution):
    """Smallest distance of the surfaces of the two worms in the run, over a."""
    first, second = np.split(np.asarray(solution.states.position), 2, axis=1)
    return np.linalg.norm(first[:, :, None] - second[:, None], axis=-1).min() - 2


def pair(distance, antiphase, contact=True):
    case = scenes.nematode_pair(15, distance, antiphase)
    scene = case.scene
    if not contact:
        scene = eqx.tree_at(lambda s: s.forces[1].strength, scene, jnp.zeros(()))
    return case._replace(scene=scene).simulate(progress=False)


alone = advance(worm)
distances = [0.35, 0.6, 1.0]
pairs = {(d, anti): pair(d, anti) for anti in (False, True) for d in distances}
ratio = {key: advance(run) / alone for key, run in pairs.items()}
gap = {key: smallest_gap(run) for key, run in pairs.items()}
through = smallest_gap(pair(0.35, False, contact=False))
closest = min(gap.values())
checks.append(("pair in phase, d = L: V/V0", ratio[1.0, False], 1.015, 5e-4))
checks.append(("pair in antiphase, d = L: V/V0", ratio[1.0, True], 1.040, 5e-4))
checks.append(("overlap with contact force, over a", max(0.0, -closest), 0.0, 1e-12))
checks.append(("beads meet without it (1: yes)", through < -0.5, 1, 0))
for key in pairs:
    name = "antiphase" if key[1] else "in phase"
    print(f"d/L = {key[0]:.2f}, {name:9s}: V/V0 = {ratio[key]:.4f}, smallest gap {gap[key]:.3f} a")
print(f"d/L = 0.35, in phase, no contact force: smallest gap {through:.3f} a")

# %%
figure, axes = plt.subplots(1, 3, figsize=(12.5, 3.6), layout="constrained", dpi=110)
axes[0].plot(numbers, speeds, "o-", color="#31688e")
axes[0].set_xlabel("number of beads $N$")
axes[0].set_ylabel("speed of one nematode $V/(fL)$")
axes[0].set_ylim(0, None)
for anti, label, colour in ((False, "in phase", "#440154"), (True, "in antiphase", "#35b779")):
    values = [ratio[d, anti] for d in distances]
    axes[1].plot(distances, values, "o-", color=colour, label=label)
axes[1].axhline(1.0, color="0.7", linewidth=1)
axes[1].set_xlabel("distance of the two $d/L$")
axes[1].set_ylabel("speed over that of one $V/V_0$")
axes[1].legend(frameon=False)
first, second = np.split(np.asarray(pairs[0.35, False].states.position) / length, 2, axis=1)
gaps = np.linalg.norm(first[:, :, None] - second[:, None], axis=-1).min(axis=(1, 2))
nearest = int(np.argmin(gaps))
for fibre, colour in ((first, "#440154"), (second, "#35b779")):
    for bead in fibre[nearest]:
        axes[2].add_patch(plt.Circle(bead, 1 / length, color=colour, linewidth=0))
axes[2].set_xlim(-0.6, 0.6)
axes[2].set_ylim(-0.5, 0.5)
axes[2].set_aspect("equal")
axes[2].set_xlabel("$x/L$")
axes[2].set_ylabel("$y/L$")
axes[2].set_title("closest approach, $d = 0.35\\,L$", fontsize=10)
plt.show()

# %% [markdown]
# ## A spiral swimmer
#
# In space a rod can prefer curvature about both axes $d_1$, $d_2$ of its material. Two equal waves a
# quarter of a period apart make a helical wave that runs from head to tail,
# $$ \kappa_0 = \kappa_1(s, t)\, d_1 + \kappa_2(s, t)\, d_2 . $$
# Wavenumber and envelope are those of the nematode, the peak curvature is $2/L$, and the rod resists
# twist as an isotropic incompressible one does, $K_t = 2 K_b/3$.
#
# The curvature at rest turns once a period in the material, at all places alike. So the rod keeps its
# shape, in which its material turns about the centreline once a period. No torque acts on the whole,
# and so the shape goes around the axis of swimming one way, the beads the other, which share the
# period between them: about $1 - r$ and $r$ turns. Were the shape but little bent, with local drag,
# $r$ would be $\zeta/(\zeta + \xi)$, with $\zeta$ the friction of the shape as it goes around, and
# $\xi$ that of beads that turn on the spot. Ten beads.


# %%
def spiral(frequency, handed=1):
    """Solution, and what the ready-made scene measures."""
    case = scenes.spiral(10, frequency)
    phase = handed * np.pi / 2  # of the wave about the second axis
    scene = eqx.tree_at(lambda s: s.forces[0].second_curvature.phase, case.scene, phase)
    case = case._replace(scene=scene)
    run = case.simulate(progress=False)
    return run, scenes.SPIRAL.observables(case, run)


frequencies = np.array([12.0, 22.6, 45.0, 90.0, 180.0])
spirals = [spiral(frequency) for frequency in frequencies]
for frequency, (_, found) in zip(frequencies, spirals, strict=True):
    print(
        f"2 pi f mu L^4/K_b = {frequency:5.1f}: V/(fL) = {found['speed']:.5f}, in a period the beads "
        f"turn {found['rotation']:+.4f} times, the shape {found['shape_rotation']:+.4f}"
    )
run, found = spirals[1]
# Half a period apart the shapes are the same, but frames in them are turned about by half a turn.
then, now = -1 - SAMPLES // 2, -1
x, frame = (np.asarray(y) for y in (run.states.position, run.states.frame))
before, after = (x[k] - x[k].mean(axis=0) for k in (then, now))
turn = jb.geometry.best_rotation(after, before, np)
half = np.sum((frame[now] @ turn) * frame[then], axis=1).mean()
checks.append(("spiral: frames after half a period", half, -1.0, 1e-4))
mirrored = spiral(22.6, handed=-1)[1]
for name, sign in (("speed", 1), ("rotation", -1), ("shape_rotation", -1)):
    checks.append((f"spiral, mirrored: {name}", mirrored[name], sign * found[name], 1e-6))

# %% [markdown]
# There is no published number for this swimmer, so the checks are of symmetry: the material must turn
# once a period in a shape that keeps, and the mirror image must swim alike and turn the other way.
# (`tests/test_scenes.py` finds speed and turns from the shape alone, by minimal power.)
# The faster the wave, the less of it the fluid lets through: the less bent shape goes around more and
# the beads turn less. The distance swum in a period is largest at the third frequency.

# %%
x = x[-1 - SAMPLES :] / 20.0
x = x - x[0].mean(axis=0)
figure, axes = plt.subplots(1, 3, figsize=(12.5, 3.4), layout="constrained", dpi=110)
for ax, (first, second) in zip(axes, ((0, 2), (1, 2)), strict=False):
    for k in range(0, SAMPLES, 5):
        ax.plot(x[k, :, first], x[k, :, second], color=viridis(k / SAMPLES), linewidth=1.6)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(f"${'xyz'[first]}/L$")
    ax.set_ylabel(f"${'xyz'[second]}/L$")
axes[1].xaxis.set_major_locator(plt.MaxNLocator(5))
scale = plt.cm.ScalarMappable(plt.Normalize(0, 1), "viridis")
figure.colorbar(scale, ax=axes[1], label="part of the period", shrink=0.8)
speed_axes = axes[2]
speed_axes.semilogx(frequencies, [s["speed"] for _, s in spirals], "o-", color="#440154")
speed_axes.set_xlabel(r"frequency $2 \pi f \mu L^4/K_b$")
speed_axes.set_ylabel("speed $V/(fL)$", color="#440154")
speed_axes.set_ylim(0, None)
turn_axes = speed_axes.twinx()
turn_axes.semilogx(frequencies, [abs(s["rotation"]) for _, s in spirals], "s--", color="#35b779")
turn_axes.set_ylabel("turns of the beads in a period", color="#35b779")
turn_axes.set_ylim(0, None)
turn_axes.set_xticks(frequencies, [f"{f:g}" for f in frequencies])
turn_axes.minorticks_off()
speed_axes.minorticks_off()
plt.show()

# %% [markdown]
# ## Three linked spheres
#
# The swimmer of Najafi and Golestanian (2004): three spheres in a row, whose two arms lengthen and
# shorten as $\ell_k = D (1 + \varepsilon \cos(2 \pi t - \varphi_k))$. For $a \ll D$ and small
# strokes its displacement in a cycle is
# $$ \Delta = \frac{7}{12} \frac{a}{D^2} \oint \ell_1 \, d\ell_2 , $$
# the last factor being the area that the stroke encloses in the plane of the arms, $\pi
# \varepsilon^2 D^2 \sin(\varphi_2 - \varphi_1)$. With RPY, an independent computation gives 1.0071
# times that at $a/D = \varepsilon = 0.01$.


# %%
measure = scenes.THREE_SPHERE.observables


def over_theory(separation, stroke):
    case = scenes.three_sphere(separation, stroke)
    return measure(case, case.simulate(progress=False))["theory_ratio"]


spacing = np.array([0.01, 0.02, 0.05, 0.1, 0.15, 0.2])  # a/D
strokes = np.array([0.01, 0.1, 0.2, 0.3, 0.4, 0.5])
by_spacing = [over_theory(1 / s, 0.01) for s in spacing]
by_stroke = [over_theory(20.0, stroke) for stroke in strokes]
checks.append(("three spheres: a/D = stroke = 0.01", by_spacing[0], 1.0071, 1e-4))
checks.append(("... extrapolated to a/D = 0", 2 * by_spacing[0] - by_spacing[1], 1.0, 1e-3))

# %% [markdown]
# **Scallop theorem.** Arms that move in phase trace their stroke back and forth, and nothing is
# gained however large it is. Their strokes are unequal here: with equal ones the swimmer is its own
# mirror image, and could not move anyway. **Time reversal.** The Stokes equations know no direction
# of time: when a prescribed drive is run backwards from where it ended, all beads retrace their
# paths. (A fibre with elastic bending relaxes, and does not.)

# %%
reciprocal = scenes.three_sphere(10.0, 0.4, phase=0.0)
arms = scenes.Arms(10.0, [4.0, 1.0], [0.0, 0.0])
scene = eqx.tree_at(lambda s: s.constraints[0].law, reciprocal.scene, arms)
start = jb.State(jnp.array([[-14.0, 0.0], [0.0, 0.0], [11.0, 0.0]]))
reciprocal = reciprocal._replace(scene=scene, state=start)
run = reciprocal.simulate(substeps=200, progress=False)
moved = float(jnp.mean(run.final.position[:, 0]) - jnp.mean(start.position[:, 0]))
travel = float(jnp.ptp(jnp.mean(run.states.position[:, :, 0], axis=1)))
forward = scenes.three_sphere(5.0, 0.4)
checks.append(("reciprocal stroke: displacement/a", moved, 0.0, 1e-10))

there = forward.simulate(tolerance=1e-10, progress=False)
arms = forward.scene.constraints[0].law
backward = scenes.Arms(arms.separation, arms.stroke, -arms.phase)  # l(-t)
scene = eqx.tree_at(lambda s: s.constraints[0].law, forward.scene, backward)
back = forward._replace(scene=scene, state=there.final).simulate(tolerance=1e-10, progress=False)
gained = float(np.abs(there.final.position - forward.state.position).max())
missed = float(np.abs(back.final.position - forward.state.position).max())
checks.append(("there and back: distance/a", missed, 0.0, 1e-8))
print(f"reciprocal stroke: travels {travel:.3f} a to and fro, gains {moved:.1e} a")
print(f"three spheres: forward {gained:.4f} a, after the way back {missed:.1e} a")

# %%
figure, axes = plt.subplots(1, 3, figsize=(12.5, 3.4), layout="constrained", dpi=110)
axes[0].plot(spacing, by_spacing, "o-", color="#31688e")
axes[0].set_xlabel(r"$a/D$, stroke $\varepsilon = 0.01$")
axes[1].plot(strokes, by_stroke, "o-", color="#31688e")
axes[1].set_xlabel(r"stroke $\varepsilon$, $a/D = 0.05$")
for ax in axes[:2]:
    ax.set_ylabel(r"displacement over $\frac{7}{12} (a/D^2)$ area")
    ax.axhline(1.0, color="0.7", linewidth=1)
t = np.concatenate([there.ts, 1 + back.ts])
x = np.concatenate([there.states.position[:, :, 0], back.states.position[:, :, 0]])
for k, colour in enumerate(("#440154", "#31688e", "#35b779")):
    axes[2].plot(t, x[:, k], color=colour, label=f"sphere {k + 1}")
axes[2].axvline(1.0, color="0.7", linewidth=1)
axes[2].set_xlabel("time (periods): forward, then backward")
axes[2].set_ylabel("position $x/a$")
axes[2].legend(frameon=False, fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1))
plt.show()

# %% [markdown]
# ## Check

# %%
print(f"{'quantity':36s} {'measured':>12s} {'reference':>10s} {'difference':>11s} {'allowed':>8s}")
for name, measured, reference, allowed in checks:
    off = abs(float(measured) - float(reference))
    print(f"{name:36s} {float(measured):12.6g} {float(reference):10.6g} {off:11.1e} {allowed:8.0e}")
for name, measured, reference, allowed in checks:
    assert abs(float(measured) - float(reference)) <= allowed, name
