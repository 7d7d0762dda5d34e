"""An independent route to the mobility of spheres: the definition, by quadrature.

Every pair tensor of the Rotne-Prager-Yamakawa theory is the average, over the surface of the sphere
that responds, of the Stokes flow of the sphere that is driven (Wajnryb et al., J. Fluid Mech. 731
(2013) R3). The flows of a sphere under a force, under a torque and in a straining fluid are classical
(Kim & Karrila, Microhydrodynamics, section 3.3); inside, the fluid moves with the sphere. Nothing of
the closed forms of the package is used here.
"""

from itertools import pairwise

import numpy as np


def sphere_flow(x, a, force, torque, strain):
    """Disturbance velocity at x (..., 3) of a sphere of radius a at the origin; viscosity 1."""
    r = np.linalg.norm(x, axis=-1, keepdims=True)
    out = np.maximum(r, a)
    n = x / np.where(r == 0, 1, r)
    fn = (n @ force)[..., None]
    stokeslet = (force / out + fn * n / out) / (8 * np.pi)
    dipole = a**2 * (force / 3 - fn * n) / out**3 / (8 * np.pi)
    forced = np.where(r > a, stokeslet + dipole, force / (6 * np.pi * a))
    turned = np.cross(np.broadcast_to(torque, x.shape), x) / (8 * np.pi * out**3)
    ex = x @ strain
    xex = np.sum(x * ex, axis=-1, keepdims=True)
    outside = -(a**5) * ex / out**5 - 2.5 * a**3 * x * xex / out**5 * (1 - (a / out) ** 2)
    return forced + turned + np.where(r > a, outside, -ex)


def response(d, a_i, a_j, force, torque, strain, nodes=60):
    """Velocity and spin of sphere i, centred at d from sphere j, which is driven.

    The sphere's surface is cut where it enters sphere j, so that the quadrature converges fast.
    """
    distance = np.linalg.norm(d)
    axis = d / distance
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side), axis])
    cut = (a_j**2 - distance**2 - a_i**2) / (2 * distance * a_i)
    edges = [-1, cut, 1] if -1 < cut < 1 else [-1, 1]
    x, w = np.polynomial.legendre.leggauss(nodes)
    velocity, spin = np.zeros(3), np.zeros(3)
    angles = 2 * np.pi * (np.arange(16) + 0.5) / 16
    for low, high in pairwise(edges):
        c = 0.5 * (low + high) + 0.5 * (high - low) * x
        s = np.sqrt(1 - c**2)
        n = np.stack(
            [s[:, None] * np.cos(angles), s[:, None] * np.sin(angles), c[:, None] + 0 * angles], -1
        )
        n = n @ frame
        weight = (0.25 * (high - low) * w / 16)[:, None, None]
        u = sphere_flow(d + a_i * n, a_j, force, torque, strain)
        velocity += (weight * u).sum((0, 1))
        spin += 1.5 / a_i * (weight * np.cross(n, u)).sum((0, 1))
    return velocity, spin


def mobility_motion(position, radius, viscosity, force, torque, strain=None):
    """Velocities and spins of all spheres under loads, and by their response to a strain."""
    strain = np.zeros((3, 3)) if strain is None else strain
    beads = len(position)
    velocity = force / (6 * np.pi * radius[:, None])
    spin = torque / (8 * np.pi * radius[:, None] ** 3)
    disturbance = np.zeros((beads, 3)), np.zeros((beads, 3))
    zero, none = np.zeros(3), np.zeros((3, 3))
    for i in range(beads):
        for j in range(beads):
            if i != j:
                d = position[i] - position[j]
                v, w = response(d, radius[i], radius[j], force[j], torque[j], none)
                velocity[i], spin[i] = velocity[i] + v, spin[i] + w
                v, w = response(d, radius[i], radius[j], zero, zero, strain)
                disturbance[0][i] += v
                disturbance[1][i] += w
    return velocity / viscosity + disturbance[0], spin / viscosity + disturbance[1]
