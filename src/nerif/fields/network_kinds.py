"""The kind of network for a flow: plain, symmetric, or with the walls of bodies."""

from __future__ import annotations

from collections.abc import Sequence

from nerif.fields.network import UNBOUNDED, Network
from nerif.fields.network_shape import NetworkShape
from nerif.fields.symmetric import SymmetricNetwork
from nerif.fields.walls import WallNetwork
from nerif.geometry import Box
from nerif.geometry.body import Body, is_thin
from nerif.geometry.symmetry import Symmetry

__all__ = ["network_in"]

THIN = 0.12  # of half the longest edge of the box: about the shortest wave of the default encoding


def network_in(
    box: Box, shape: NetworkShape, bounds: tuple[float, float] = UNBOUNDED, symmetry: Symmetry | None = None,
    bodies: Sequence[Body] = (),
) -> Network:  # fmt: skip
    """Return a network with random weights from torch's global generator, for a field in a box.

    Parameters
    ----------
    bounds : in network units
    symmetry, bodies : in mm; thin bodies are walls, but not in a symmetric network. Through a thick one the network
        continues, where there are no data
    """
    unit = max(box.edges) / 2
    if symmetry is not None:
        return SymmetricNetwork(shape, symmetry.in_units(box.centre, unit), bounds)
    walls = [body.in_units(box.centre, unit) for body in bodies if is_thin(body, THIN * unit)]
    if walls:
        return WallNetwork(shape, walls, bounds)
    return Network(shape, bounds)
