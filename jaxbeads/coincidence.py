"""Beads in one place: fibres that coincide, a fibre folded back exactly. On the host."""

import numpy as np

from .chain import Chain
from .state import State


def coincidence(state: State, chain: Chain, *, oriented: bool = False) -> str | None:
    """Which beads of one size are in one place, in words, or `None`; whole bonds first.

    Hydrodynamics moves such beads as one, so that nothing can be demanded of each. `oriented`: only
    those whose directors are parallel as well. Of several such places the first is named.
    """
    place = _places(state, chain, oriented)
    if len(set(place.tolist())) == chain.beads:
        return None
    return overlaid(state, chain, oriented=oriented) or _said(chain, place, *_twins(place))


def overlaid(state: State, chain: Chain, *, oriented: bool = False) -> str | None:
    """As `coincidence`, of whole bonds only: two neighbours in the places of two others (or of one
    another's other neighbour). No chain constraint can tell these bonds apart.
    """
    place, bonds = _places(state, chain, oriented), np.flatnonzero(chain.bond_mask)
    ends = np.sort(np.stack([place[bonds], place[bonds + 1]], axis=1), axis=1)
    _, which = np.unique(ends, axis=0, return_inverse=True)
    which = which.reshape(-1)
    if len(set(which.tolist())) == len(bonds):
        return None
    one, other = (int(bonds[k]) for k in _twins(which))
    if place[one] != place[other]:  # they run in opposite directions
        other += 1
    return _said(chain, place, one, other)


def _twins(labels: np.ndarray) -> tuple[int, int]:
    """The first two entries with one label."""
    _, first, which = np.unique(labels, return_index=True, return_inverse=True)
    second = int(np.argmax(first[which.reshape(-1)] != np.arange(len(labels))))
    return int(first[which.reshape(-1)[second]]), second


def _said(chain: Chain, place: np.ndarray, one: int, other: int) -> str:
    first, second = (int(k) for k in chain.fibre_of_bead[[one, other]])
    where = f"beads {one} and {other} are in one place"
    if first == second:
        near = other - one == 2
        return f"fibre {first} {'is folded back onto' if near else 'meets'} itself: {where}"
    sets = [set(place[chain.fibre_of_bead == k].tolist()) for k in (first, second)]
    common = len(sets[0] & sets[1])
    if common == max(map(len, sets)):
        how = f"fibres {first} and {second} coincide"
    elif common == 1:
        how = f"fibres {first} and {second} cross in the centre of a bead"
    else:
        how = f"fibres {first} and {second} lie on one another in part"
    return f"{how}: {where} (`centre` of `straight` and `from_tangents` sets fibres apart)"


def _places(state: State, chain: Chain, oriented: bool) -> np.ndarray:
    """A number for each bead, the same for those of one size whose distance is rounding."""
    position = np.asarray(state.position, float)
    # By numpy alone: within `jit` what JAX makes of known numbers is not known.
    radii = np.broadcast_to(np.asarray(chain.radius, float), len(position))
    columns = [position, radii[:, None]]
    if oriented and state.director is not None:
        p = np.asarray(state.director, float)
        columns.append(radii[:, None] * (p[:, :, None] * p[:, None, :]).reshape(len(p), -1))
    points = np.concatenate(columns, axis=1)
    rounding = 64 * float(np.finfo(np.asarray(state.position).dtype).eps) * np.abs(points).max()
    # Sorted along a direction in which no two points that differ are likely to meet.
    order = np.argsort(points @ np.sqrt(2 + np.arange(points.shape[1])), kind="stable")
    steps = np.abs(np.diff(points[order], axis=0)).max(axis=1, initial=0.0)
    place = np.empty(len(points), int)
    place[order] = np.cumsum(np.concatenate([[0], steps > rounding]))
    return place
