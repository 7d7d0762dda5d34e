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
# # Many fibres
#
# A cloud of fibres that settles and a suspension of fibres in shear, eight fibres of ten beads each.
# Limits in which they are known come first: fibres far apart, rods that nothing bends, one sphere.
# Units: bead radius, viscosity, weight of a bead and shear rate are 1.

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np

import jaxbeads as jb
import jaxbeads.plot
from jaxbeads import scenes
from jaxbeads.constraint import Gears
from jaxbeads.flow import Extension
from jaxbeads.mobility import RPY
from jaxbeads.stress import particle_stress

plt.rcParams["figure.dpi"] = 110
checks = []  # rows of the table at the end: quantity, measured, reference, allowed difference
FIBRES, BEADS = 8, 10

# %% [markdown]
# ## A cloud that settles
#
# The fibres start straight, with random directions, on a lattice, and fall by two lengths and more. Each
# drags fluid along, in which the others fall too, so that a cloud falls faster than one fibre, the
# faster the denser it is. They bend ($B = FL^2/K_b = 1000$), and `Contact` keeps them apart.

# %%
cloud = scenes.cloud(FIBRES, BEADS, 1000.0, spacing=0.6)
length = float(cloud.scene.chain.length[0])
fall = cloud.simulate(progress=False)
found = scenes.CLOUD.observables(cloud, fall)
print(
    f"falls {found['speed']:.3f} times as fast as one rigid horizontal fibre; its size changes by "
)
print(f"{found['spread']:.3f} along gravity, {found['spread_lateral']:.3f} across it; ", end="")
print(f"surfaces come as near as {found['smallest_gap']:.3f} a; {int(fall.steps)} steps")
view = jaxbeads.plot.View(up=(0.0, 1.0, 0.0), azimuth=20.0, elevation=8.0)
figure, axis = plt.subplots(figsize=(4.4, 6.4), layout="constrained")
jaxbeads.plot.shapes(fall, cloud.scene.chain, number=3, view=view, axes=axis)
plt.show()

# %% [markdown]
# The limit: far from one another, each fibre falls as if alone, and in the flow of the others' weights,
# each a point force $F$ at a distance $r$ under an angle $\theta$ from gravity:
# $$ V - V_\text{alone} = \sum \frac{F}{8\pi\mu r} (1 + \cos^2\theta) . $$
# One instant of eight fibres on a wide lattice, less that of each by itself:


# %%
def fall_speed(case, position):
    chain = jb.Chain(1.0, (BEADS,) * (len(position) // BEADS))
    scene = jb.Scene(chain, 1.0, constraints=[Gears()], forces=[case.scene.forces[0]])
    moved = jb.dynamics.motion(0.0, jb.State(position), scene)
    return -np.asarray(moved.velocity)[:, 1].mean()


for spacing in (4.0, 8.0):
    wide = scenes.cloud(FIBRES, BEADS, spacing=spacing)
    position = wide.state.position
    each = [fall_speed(wide, position[k * BEADS : (k + 1) * BEADS]) for k in range(FIBRES)]
    centres = np.asarray(wide.scene.chain.centres(position))
    apart = centres[:, None] - centres[None] + np.eye(FIBRES)[:, :, None]
    r = np.linalg.norm(apart, axis=2)
    pairs = BEADS / (8 * np.pi * r) * (1 + (apart[:, :, 1] / r) ** 2) * (1 - np.eye(FIBRES))
    law = pairs.sum(axis=1).mean()
    gain = fall_speed(wide, position) - np.mean(each)
    print(f"{spacing:.0f} L apart: faster by {gain:.6f}, point forces {law:.6f}")
checks.append(("cloud 8 L apart: gain over that of point forces", gain / law, 1.0, 1e-3))

# %% [markdown]
# ## What fibres add to the stress
#
# The stresslet of a sphere that is strained at the rate $E$ is $\frac{20}{3}\pi\mu a^3 E$. A rod of length
# $L$ along an extension resists as a slender body (Batchelor, J. Fluid Mech. 46 (1971) 813), here of beads
# that do not resist strain themselves:
# $$ S_{xx} = \tfrac23 \cdot \frac{\pi\mu \dot\epsilon L^3}{6} \left[\epsilon\,
# \frac{1 + 0.64\,\epsilon}{1 - 1.5\,\epsilon} + 1.659\,\epsilon^3\right], \qquad \epsilon = 1/\ln(L/a) . $$
# They agree to 5 % and better, the longer the rod: the series is one in $1/\ln(L/a)$, and a row of beads
# is not quite a cylinder.

# %%
sphere = jb.Scene(jb.Chain(1.0, 1), 1.0, flow=Extension(1.0))
one = particle_stress(0.0, jb.State([[3.0, 1.0, 0.0]]), sphere)[0, 0, 0]
checks.append(("sphere: stress over 20 pi mu a^3/3 E", one / (20 * np.pi / 3), 1.0, 1e-12))


def stress_of_a_rod(beads):
    chain = jb.Chain(1.0, beads)
    scene = jb.Scene(chain, 1.0, RPY(strained=False), [Gears()], flow=Extension(1.0))
    return float(particle_stress(0.0, jb.straight(chain, [1.0, 0.0]), scene)[0, 0, 0])


ratios = []
for beads in (20, 40, 80):
    e = 1 / np.log(2 * beads)
    slender = e * (1 + 0.64 * e) / (1 - 1.5 * e) + 1.659 * e**3
    ratios.append(stress_of_a_rod(beads) / (np.pi * (2 * beads) ** 3 / 9 * slender))
    print(f"{beads} beads: {ratios[-1]:.4f} of Batchelor's value")
checks.append(("rod of 80 beads: stress over Batchelor's", ratios[-1], 1.0, 0.03))

# %% [markdown]
# ## A suspension in shear
#
# First two stiff fibres, five lengths apart: each follows Jeffery's orbit,
# $\dot p = \Omega\times p + \lambda\,(E p - (p\cdot E p)\,p)$ with $\lambda = (r^2 - 1)/(r^2 + 1)$, where $r$
# belongs to the period of ten beads, $2\pi(r + 1/r) = 52.942$. The same directions, followed by that
# equation alone, have the moments of the scene.

# %%
stiff = scenes.shear_suspension(2, BEADS, bending_ratio=1.0, spacing=5.0)
orbits = stiff.simulate(progress=False, tolerance=1e-5)
dilute = scenes.SHEAR_SUSPENSION.observables(stiff, orbits)

half = 52.942 / (4 * np.pi)
ratio = half + np.sqrt(half**2 - 1)
shape = (ratio**2 - 1) / (ratio**2 + 1)
strain = np.array([[0.0, 0.5, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
turn = np.array([[0.0, 0.5, 0.0], [-0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])


def jeffery(p):
    drag = p @ strain
    return p @ turn.T + shape * (drag - np.sum(p * drag, axis=1)[:, None] * p)


start = np.asarray(stiff.state.position).reshape(2, BEADS, 3)
p = start[:, -1] - start[:, 0]
p = p / np.linalg.norm(p, axis=1)[:, None]
h, path = (stiff.ts[1] - stiff.ts[0]) / 4, []
for k in range(4 * len(stiff.ts) - 3):  # four steps of Runge and Kutta between saved times
    if k % 4 == 0:
        path.append(p)
    a = jeffery(p)
    b = jeffery(p + h / 2 * a)
    c = jeffery(p + h / 2 * b)
    p = p + h / 6 * (a + 2 * b + 2 * c + jeffery(p + h * c))
late = np.array(path)[len(path) // 2 :]
products = [late[..., 0] ** 2, late[..., 1] ** 2, late[..., 0] * late[..., 1]]
alone = [np.trapezoid(x.mean(axis=1)) / (len(late) - 1) for x in products]
for name, measured, reference in zip(("xx", "yy", "xy"), dilute["moments"], alone, strict=True):
    print(f"<p_{name[0]} p_{name[1]}>: {measured:.4f}, by Jeffery's equation {reference:.4f}")
    checks.append((f"dilute suspension: <p_{name[0]} p_{name[1]}>", measured, reference, 2e-3))

# %% [markdown]
# Now flexible ones, one length apart, which meet and bend.

# %%
dense = scenes.shear_suspension(4, 6)
sheared = dense.simulate(progress=False, tolerance=1e-4)
found_in_shear = scenes.SHEAR_SUSPENSION.observables(dense, sheared)
for name, of in (("stiff, 5 L apart", dilute), ("flexible, 1 L apart", found_in_shear)):
    moments = ", ".join(f"{x:.3f}" for x in of["moments"])
    print(f"{name:20} moments {moments}; largest curvature {of['curvature']:.3f}/L; ", end="")
    print(
        f"shear stress {of['shear_stress']:.5f}, normal stress {of['normal_stress']:.5f} mu rate L^3"
    )
figure, axis = plt.subplots(figsize=(6.5, 3.2), layout="constrained")
for name, case, run in (("stiff", stiff, orbits), ("flexible", dense, sheared)):
    x = np.asarray(run.states.position)
    x = x.reshape(len(x), -1, case.scene.chain.fibres[0], 3)
    ends = x[:, :, -1] - x[:, :, 0]
    ends = ends / np.linalg.norm(ends, axis=2, keepdims=True)
    axis.plot(case.ts, (ends[..., 0] * ends[..., 1]).mean(axis=1), label=name)
axis.set(xlabel="time times shear rate", ylabel=r"mean $p_x p_y$")
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# ## Check

# %%
print(f"{'quantity':50s} {'measured':>12s} {'reference':>10s} {'off by':>9s} {'allowed':>9s}")
for name, measured, reference, allowed in checks:
    off = abs(float(measured) - float(reference))
    print(f"{name:50s} {float(measured):12.6g} {float(reference):10.6g} {off:9.1e} {allowed:9.0e}")
for name, measured, reference, allowed in checks:
    assert abs(float(measured) - float(reference)) <= allowed, name
assert found["speed"] > 2 and found["smallest_gap"] > 0
assert 1.05 > ratios[0] > ratios[1] > ratios[2]
assert found_in_shear["curvature"] > 10 * dilute["curvature"]
