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
# # Fibres and swimmers near a wall
#
# What a no-slip wall does to a fibre that settles beside it, and to a worm that swims along it. Units:
# bead radius, viscosity, weight of a bead and frequency of the beat are 1.

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np

import jaxbeads as jb
from jaxbeads import scenes
from jaxbeads.loads import load_on_fluid

plt.rcParams["figure.dpi"] = 110
checks = []  # rows of the table at the end: quantity, measured, reference, allowed difference

# %% [markdown]
# ## Settling beside a wall
#
# A rod settles, its lower end turned towards a vertical wall. It slides along its axis, to the wall;
# there it turns, its lower end away, and leaves (Russel, Hinch, Leal & Tieffenbruck, J. Fluid Mech. 83
# (1977) 273, call this a glancing turn). Stokes flow has no direction of time: a rigid rod leaves at the
# angle at which it came. A flexible fibre remembers what it went through: it bends.

# %%
BEADS, ANGLE = 10, 0.3
falls = {}
for name, number in (("rigid", 0.01), ("B = 20", 20.0), ("B = 100", 100.0)):
    case = scenes.settling_wall(BEADS, number, 0.5, ANGLE, fall=14.0)
    run = jb.simulate(case.scene, case.state, case.ts, tolerance=1e-6, progress=False)
    x = np.asarray(run.states.position)
    length = float(case.scene.chain.length[0])
    ends = x[:, -1] - x[:, 0]
    angle = np.arctan2(ends[:, 0], -ends[:, 1])  # from the vertical, lower end away from the wall
    away = x[:, :, 0].mean(axis=1) / length
    falls[name] = away, angle, x, (x[:, :, 0].min() - 1) / length
    print(f"{name:8} closest {falls[name][3]:.3f} L, ", end="")
    print(f"comes at {angle[0]:+.3f} rad, leaves {away[0]:.1f} L from the wall ", end="")
    nearest = int(np.argmin(away))
    passed = away[nearest:] > away[0]
    if passed.any():
        back = np.interp(away[0], away[nearest:], angle[nearest:])
        print(f"at {back:+.3f} rad")
    else:
        print("never")
    falls[name] += (back if passed.any() else np.nan,)
checks.append(("rigid rod: angle at which it leaves", falls["rigid"][4], ANGLE, 1e-3))

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for (name, (away, angle, x, _, _)), colour in zip(
    falls.items(), ("#440154", "#31688e", "#35b779"), strict=True
):
    axes[0].plot(np.degrees(angle), away, color=colour, label=name)
    for k in range(0, len(x), 50):
        axes[1].plot(x[k, :, 0] / length, x[k, :, 1] / length, color=colour, linewidth=1.5)
axes[0].set(
    xlabel="tilt, lower end away from the wall (degrees)", ylabel="distance from the wall$/L$"
)
axes[0].legend(frameon=False)
axes[1].axvline(0, color="0.4", linewidth=3)
axes[1].set(xlabel="$x/L$ (stretched)", ylabel="$y/L$")
plt.show()

# %% [markdown]
# ## Swimming along a wall
#
# The flow far from a swimmer is that of its stresslet $S$, and the wall's image of it moves the swimmer
# (Berke, Turner, Berg & Lauga, Phys. Rev. Lett. 101 (2008) 038102). At a height $h$, with $y$ normal to
# the wall, the image gives
# $$ u_y = \frac{9 S_{yy}}{64 \pi \mu h^2}, \qquad u_x = \frac{3 S_{xy}}{32 \pi \mu h^2} . $$
# So a swimmer that pushes, $S = p\, (e e - I/3)$ with $p > 0$, comes nearer if it swims along the wall.
# $S$ is found without a wall: it is the mean first moment of the forces on the fluid, its symmetric part
# without trace.
# A period of the beat is followed with and without wall from the same shapes, at a slant of 0.4 rad;
# the difference times $h^2$, extrapolated from $h = 20 L$ and $40 L$, must be the law's.

# %%
WORM, SLANT = 9, 0.4
free = scenes.nematode(WORM)
size = float(free.scene.chain.length[0])
swum = free.simulate(progress=False).final
turn = np.array([[np.cos(SLANT), -np.sin(SLANT)], [np.sin(SLANT), np.cos(SLANT)]])
start = np.asarray(swum.position - swum.position.mean(axis=0)) @ turn.T
ts = np.linspace(0.0, 1.0, 65)
options = dict(solver=jb.Rosenbrock(substeps=4), progress=False)


def displacement(scene, height):
    run = jb.simulate(scene, jb.State(start + np.array([0.0, height])), ts, **options)
    return np.asarray(run.final.position - run.states.position[0]).mean(axis=0), run


alone, beat = displacement(free.scene, 0.0)
forces = jax.jit(jax.vmap(lambda t, state: load_on_fluid(t, state, free.scene).force))
force = np.asarray(forces(beat.ts, beat.states))[:-1]
moment = np.einsum("tni,tnj->ij", np.asarray(beat.states.position)[:-1], force) / 64
stresslet = (moment + moment.T) / 2 - np.trace(moment) / 3 * np.eye(2)
law = np.array([3 * stresslet[0, 1] / 32, 9 * stresslet[1, 1] / 64]) / np.pi
scaled = []
for far in (20.0, 40.0):
    walled = scenes.nematode_wall(WORM, far).scene
    scaled.append((far * size) ** 2 * (displacement(walled, far * size)[0] - alone))
    print(f"h = {far:.0f} L: h^2 times what the wall adds in a period {scaled[-1]}, law {law}")
limit = 2 * scaled[1] - scaled[0]
own = turn.T @ stresslet @ turn  # of the worm that swims along x
print(f"along the wall: u_y = {9 * own[1, 1] / (64 * np.pi):.4f}/h^2")
for k, name in enumerate("xy"):
    checks.append((f"worm far from the wall: {name} of the law", limit[k] / law[k], 1.0, 1e-2))

# %% [markdown]
# Close to the wall none of this holds: distances are as the length of the worm, and the wave is felt
# as it passes. Ten periods from straight, at several heights and headings towards the wall:

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
swims = {}
for heading, axis in zip((0.0, 0.3), axes, strict=True):
    for height, colour in zip((0.35, 0.5, 0.8), ("#440154", "#31688e", "#35b779"), strict=True):
        case = scenes.nematode_wall(WORM, height, heading)
        run = case.simulate(progress=False)
        centre = np.asarray(run.states.position).mean(axis=1) / size
        way = np.diff(centre[:: len(case.ts) // 10], axis=0)  # of each period
        course = np.arctan2(way[:, 1], way[:, 0])
        swims[heading, height] = way[-1], course[-1] - course[1], centre[-1, 1]
        axis.plot(*centre.T, color=colour)
        print(
            f"from {height} L, heading {heading:+.1f} rad to the wall: speed {way[-1, 0]:.4f} f L, ",
            end="",
        )
        print(
            f"turns away by {swims[heading, height][1]:+.3f} rad, at the end at {centre[-1, 1]:.3f} L"
        )
    axis.axhline(0, color="0.4", linewidth=3)
    axis.set(xlabel="$x/L$", ylabel="$y/L$", title=f"heading {heading} rad to the wall")
plt.show()

# %% [markdown]
# The nearer the wall, the faster the worm swims along it. From afar its image draws it to the wall (the
# negative $u_y$ above); at all of these heights it turns away.

# %% [markdown]
# ## Check

# %%
print(f"{'quantity':42s} {'measured':>12s} {'reference':>10s} {'off by':>9s} {'allowed':>9s}")
for name, measured, reference, allowed in checks:
    off = abs(float(measured) - float(reference))
    print(f"{name:42s} {float(measured):12.6g} {float(reference):10.6g} {off:9.1e} {allowed:9.0e}")
for name, measured, reference, allowed in checks:
    assert abs(float(measured) - float(reference)) <= allowed, name
assert own[1, 1] < 0
assert falls["B = 20"][3] < falls["rigid"][3]  # what bends comes closer
assert falls["B = 100"][3] < 0.02 and np.isnan(falls["B = 100"][4])  # and stays
speeds = [swims[0.0, height][0][0] for height in (0.35, 0.5, 0.8)]
assert speeds[0] > speeds[1] > speeds[2]
assert all(turn > 0 for _, turn, _ in swims.values())
