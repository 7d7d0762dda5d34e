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
# # A flexible fibre settling under its weight
#
# Section 3.3 of Delmotte, Climent & Plouraboué, J. Comput. Phys. 286 (2015) 14-37; their Figs. 10 and 11.
#
# A fibre that starts horizontally falls through a fluid at rest. Its middle falls in the wake of
# all other beads and runs ahead; elasticity resists. What happens depends on the elasto-gravitational number
#
# $$B = \frac{F L^2}{K_b}, \qquad (55)$$
#
# with $F$ the weight of the whole fibre, $L$ its length and $K_b$ its bending rigidity. Measured
# are the deflection $A$, the height between the highest and the lowest bead centre, as $A/L$, and
# the friction coefficient $\gamma = F/V$, as $\gamma/\gamma_0$, where $\gamma_0$ is that of the
# straight rigid fibre across its axis. Times are in units of $L/V_s$, with $V_s = F/\gamma$ the
# speed of the steady shape.

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np

from jaxbeads import scenes
from jaxbeads.observables import deflection
from jaxbeads.scenes import SCENES

UP = [0.0, 1.0]
observables = next(scene.observables for scene in SCENES if scene.name == "settling")

# %% [markdown]
# ## Gears, from stiff to soft
#
# 34 touching beads that roll on one another. Each run ends when the shape is steady. The
# scene's own solver takes linearly implicit steps: tens of them, where explicit ones would have to follow
# the fastest bending rate, 60 000 at B = 1000 and millions at B = 10.

# %%
gears_numbers = np.array([10.0, 30.0, 100.0, 150.0, 300.0, 1000.0, 10_000.0])
gears, runs = {}, {}
for number in gears_numbers:
    case = scenes.settling(34, number, scenes.GEARS)
    runs[number] = case, case.simulate(progress=False)
    gears[number] = observables(*runs[number])
    print(f"B = {number:7g}: A/L = {gears[number]['deflection']:.5f}", end=", ")
    print(f"friction = {gears[number]['friction_ratio']:.4f}")

# %% [markdown]
# ## Shapes at $B = 10^4$ (Fig. 10)
#
# A soft fibre first folds to a W, which only an asymmetry can leave. The fibre is symmetric but for the
# perturbation of the scene, a slope of $10^{-6}$ rad at one end: how long the W lives is therefore a
# property of that perturbation (a larger one ends it earlier), the horseshoe after it is not.

# %%
case, run = runs[10_000.0]
length = float(case.scene.chain.length[0])
speed_of_rod = case.scene.chain.beads / float(scenes.settling_friction(case.scene))  # weight 34
terminal_speed = speed_of_rod / gears[10_000.0]["friction_ratio"]
position = np.asarray(run.states.position)
shape = (position - position.mean(axis=1, keepdims=True)) / length
time = np.asarray(run.ts) * terminal_speed / length
asymmetry = np.abs(shape[:, :, 1] - shape[:, ::-1, 1]).max(axis=1)


def troughs(height):
    """Number of local minima of the height along the fibre, its ends not counted."""
    slope = np.diff(height)
    return int(np.sum((slope[:-1] < 0) & (slope[1:] > 0)))


snapshots = {at: int(np.argmin(np.abs(time - at))) for at in (12.0, 53.0)}
troughs_at = {at: troughs(shape[now, :, 1]) for at, now in snapshots.items()}
asymmetry_at = {at: float(asymmetry[now]) for at, now in snapshots.items()}
for at in snapshots:
    print(f"t = {at:g} L/V_s: {troughs_at[at]} trough(s), asymmetry {asymmetry_at[at]:.1e} L")
broken = time[np.argmax(asymmetry > 0.1)]
print(f"the asymmetry exceeds 0.1 L from t = {broken:.1f} L/V_s on", end=" ")
print(f"(or {broken * speed_of_rod / terminal_speed:.1f} in units of L over the rod's speed)")

# %%
figure, (left, middle, right) = plt.subplots(1, 3, figsize=(10.5, 3.4), layout="constrained")
colours = {12.0: "#31688e", 53.0: "#440154"}
for ax, at, name in ((left, 12.0, "W"), (middle, 53.0, "horseshoe")):
    for centre in shape[snapshots[at]]:  # the radius is L/68
        ax.add_patch(plt.Circle(centre, 1 / 68, color=colours[at], linewidth=0))
    ax.set(xlim=(-0.42, 0.42), ylim=(-0.3, 0.35), aspect="equal")
    ax.set(xlabel="$(x - x_c)/L$", ylabel="$(y - y_c)/L$")
    ax.set_title(f"{name}, $t = {at:g}\\, L/V_s$", fontsize=10)
height = np.asarray(deflection(position, UP)) / length
right.plot(time, height, color="#21918c", label="deflection $A/L$")
right.plot(time, asymmetry, color="0.5", linestyle="--", label="asymmetry, over $L$")
for at, colour in colours.items():
    right.plot(at, np.interp(at, time, height), "o", color=colour)
right.set(xlabel="$t\\, V_s/L$", xlim=(0, 60), yscale="log", ylim=(1e-7, 10))
right.legend(loc="upper right", fontsize=8, frameon=False)
plt.show()

# %% [markdown]
# Gravity points down; the beads are drawn to scale. The asymmetry grows exponentially out of the
# perturbation until it breaks the W, and dies out in the horseshoe. (Asymmetry: largest difference of
# the heights of two beads at the same distance from either end.)

# %% [markdown]
# ## Joint Model
#
# 31 beads with gaps of $2\epsilon_g = 0.2a$, linked by ball-and-socket joints, with the repulsion of
# the paper. Their length is that of the 34 gears to 0.3 %.

# %%
joint = {}
for number in (30.0, 100.0, 1000.0, 10_000.0):
    case = scenes.settling(31, number, scenes.JOINT)
    joint[number] = observables(case, case.simulate(progress=False))
print(f"length of the joint fibre: {float(case.scene.chain.length[0]):.1f} a")

# %% [markdown]
# ## Deflection and friction against $B$ (Fig. 11)
#
# The relative differences are $\epsilon_A = (A_G - A_J)/A_G$, eq. (56), and the same of
# $\gamma/\gamma_0$, eq. (57).

# %%
difference = {
    number: [
        1 - joint[number][key] / gears[number][key] for key in ("deflection", "friction_ratio")
    ]
    for number in joint
}
print("      B     A/L gears     joint  eps_A, %   friction gears    joint  eps_gamma, %")
for number, (of_height, of_friction) in difference.items():
    g, j = gears[number], joint[number]
    print(
        f"{number:7g}  {g['deflection']:12.5f} {j['deflection']:9.5f} {100 * of_height:9.2f}"
        f"  {g['friction_ratio']:15.4f} {j['friction_ratio']:8.4f} {100 * of_friction:13.2f}"
    )

# %%
heights = np.array([gears[number]["deflection"] for number in gears_numbers])
frictions = np.array([gears[number]["friction_ratio"] for number in gears_numbers])
exponents = np.diff(np.log(heights)) / np.diff(np.log(gears_numbers))
for low, high, exponent in zip(gears_numbers[:-1], gears_numbers[1:], exponents, strict=True):
    print(f"A ~ B^{exponent:.3f} between B = {low:g} and {high:g}")

# %%
known = {100.0: (0.09751, 0.9840), 1000.0: (0.40260, 0.7059)}  # independent codes, N = 34
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
for ax, values, key, column in (
    (left, heights, "deflection", 0),
    (right, frictions, "friction_ratio", 1),
):
    ax.plot(gears_numbers, values, "o-", color="#31688e", label="Gears, $N = 34$")
    ax.plot(joint.keys(), [j[key] for j in joint.values()], "s", color="#d95f02", ms=9, mfc="none")
    ax.plot([], [], "s", color="#d95f02", ms=9, mfc="none", label="Joint, $N = 31$")
    ax.plot(
        known.keys(), [k[column] for k in known.values()], "k+", ms=13, label="independent codes"
    )
    ax.set(xscale="log", xlabel="elasto-gravitational number $B$")
linear = np.array([8.0, 300.0])
left.plot(linear, heights[0] / 10 * linear, color="0.6", linestyle=":", label="$A \\sim B$")
left.set(yscale="log", ylabel="deflection $A/L$")
right.set(ylabel="friction $\\gamma/\\gamma_0$")
left.legend(frameon=False)
plt.show()

# %% [markdown]
# At small $B$ the deflection is proportional to $B$. Beyond $B = 100$ it grows faster than that, because a
# bent fibre has less friction and falls faster; then it saturates, for the length is given.
#
# The paper finds differences of the two models below 5 %, except at the threshold $B \approx 100$, with
# 15 % in the deflection and 7.5 % in the friction. Such a peak is not found here. The deflections
# differ by some 4.5 % all through the linear regime, at $B = 100$ too, and by much less when the
# fibre is soft; the frictions never differ by more than 1 %.

# %%
largest = np.abs(list(difference.values())).max(axis=0)
print(f"largest differences of the models: {100 * largest[0]:.1f} % in deflection, ", end="")
print(f"{100 * largest[1]:.1f} % in friction (paper: 15 %, 7.5 %)")

# %% [markdown]
# ## Check

# %%
checks = [  # quantity, measured, reference, allowed difference
    ("A/L, B = 100", gears[100.0]["deflection"], 0.09751, 1e-5),
    ("friction, B = 100", gears[100.0]["friction_ratio"], 0.9840, 1e-4),
    ("A/L, B = 1000", gears[1000.0]["deflection"], 0.40260, 1e-5),
    ("friction, B = 1000", gears[1000.0]["friction_ratio"], 0.7059, 1e-4),
    ("exponent of A ~ B, B = 10 to 30", exponents[0], 1.0, 0.01),
    ("troughs at t = 12 L/V_s", troughs_at[12.0], 2, 0),
    ("troughs at t = 53 L/V_s", troughs_at[53.0], 1, 0),
    ("asymmetry at t = 12 L/V_s", asymmetry_at[12.0], 0.0, 0.02),
    ("asymmetry at t = 53 L/V_s", asymmetry_at[53.0], 0.0, 1e-3),
]
for number, (of_height, of_friction) in difference.items():
    checks.append((f"eps_A, B = {number:g}", of_height, 0.0, 0.05))
    checks.append((f"eps_gamma, B = {number:g}", of_friction, 0.0, 0.015))
print(f"{'quantity':34}{'measured':>11}{'reference':>11}{'difference':>12}{'allowed':>10}")
for name, value, reference, allowed in checks:
    print(f"{name:34}{value:11.5f}{reference:11.5f}{value - reference:12.1e}{allowed:10.1e}")
for name, value, reference, allowed in checks:
    assert abs(value - reference) <= allowed, name
