"""Random numbers as a pure function of the seed and of what they are for.

No generator is shared and none has a history: whoever needs random numbers names their purpose and the
entities they belong to, so the same image comes out whatever the number of workers or their order.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """Purposes of random numbers; the values are part of what a seed means, so none is ever renumbered."""

    LENS = 1
    PLACEMENT = 2
    DRIFT = 3
    BOARD_POSES = 4
    BOARD_NOISE = 5
    SUBJECT_NOISE = 6
    PLATE_NOISE = 7
    GREEN_SCREEN = 8
    VIGNETTING = 9
    IDENTITY = 10
    HAIR = 11
    SKIN = 12
    EYES = 13
    ASSETS = 14


def generator(seed: int, stream: Stream, *entities: int) -> np.random.Generator:
    """The generator for one purpose (`stream`) and its entities (take, camera, frame, ... as integers)."""
    sequence = np.random.SeedSequence(seed, spawn_key=(int(stream), *entities))
    return np.random.Generator(np.random.Philox(sequence))
