"""Size of the network: layers, neurons, and the waves of its encoding."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from nerif.common.conventions import InputError
from nerif.common.settings import Count, Developer, Natural, check_settings

__all__ = ["DIRECTIONS", "NetworkShape", "encoded_width"]


def _unit(count: int) -> list[tuple[float, ...]]:
    """Directions, up to their sign, with `count` nonzero components of equal size."""
    vectors = [v for v in itertools.product((1, 0, -1), repeat=3) if sum(map(abs, v)) == count]
    return [tuple(x / math.sqrt(count) for x in v) for v in vectors if v > tuple(-x for x in v)]


AXES = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
DIRECTIONS = {3: AXES, 9: [*AXES, *_unit(2)], 13: [*AXES, *_unit(2), *_unit(3)]}
"""By their number: the axes of the box; with the face diagonals of a cube; with its space diagonals as well."""


def encoded_width(octaves: int, directions: int) -> int:
    """Return 3 + 2 N D, the width of the encoding of a point by N octaves along D directions."""
    return 3 + 2 * octaves * directions


@dataclass(frozen=True)
class NetworkShape:
    """Size of the network."""

    depth: Count = 4
    """Hidden layers before the heads (paper: 7)."""
    width: Count = 96
    """Neurons per hidden layer (paper: 256)."""
    octaves: Natural = 5
    """N of the sinusoidal encoding; octaves beyond the fifth are weighted down, see Network."""
    directions: int = 13
    """Directions of the waves of each octave: 3 axes (the paper's), 9 with face diagonals, 13 with space diagonals."""
    skip: Natural = 0
    """Layer to whose output the encoding is joined (paper: 4); 0 for none."""
    head_width: Natural = 0
    """Neurons of each head (paper: 64); 0 for one linear output."""
    gradient_head: bool = False
    """Whether the three heads for grad(n) exist."""
    activation: Literal["silu", "softplus", "tanh", "relu", "sine"] = "silu"
    """Silu, softplus, tanh, relu or sine."""
    octave_decay: Annotated[float, Developer] = 0.0
    """Weight 2^(-k octave_decay) of octave k of the encoding (paper: 0)."""

    def __post_init__(self) -> None:
        check_settings(self)
        if self.directions not in DIRECTIONS:
            raise InputError(
                f"expected one of {', '.join(map(str, DIRECTIONS))}, got {self.directions}", field="directions"
            )

    def without_waves_below(self, length: float) -> NetworkShape:
        """Return the shape without octaves with wavelengths 2^(1 - k) below a length; one octave stays."""
        finest = sum(2.0 ** (1 - k) >= length for k in range(self.octaves))
        return replace(self, octaves=min(self.octaves, max(finest, 1)))

    @classmethod
    def of(cls, settings: dict[str, Any], weights: float = math.inf) -> NetworkShape:
        """Return the shape stored in a file; older files have no directions, which are then the axes.

        Parameters
        ----------
        weights : number of those in the file
        """
        shape = cls(**{"directions": 3, **settings})
        inputs = encoded_width(shape.octaves, shape.directions)
        if shape.width * (inputs + (shape.depth - 1) * shape.width + shape.head_width) > weights:
            raise InputError(f"expected a network of the {weights} weights stored, got a larger one", field="network")
        return shape
