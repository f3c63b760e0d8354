"""Type aliases shared by the whole package. Shapes: B batch, F factors."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent_envs.types import Bools as Bools
from mbagent_envs.types import Floats as Floats
from mbagent_envs.types import Ints as Ints
from mbagent_envs.types import Keys as Keys

States: TypeAlias = NDArray[np.int64]
"""States in factors, int64 [B, F]."""
Actions: TypeAlias = NDArray[np.int64]
"""Numbers of the enumerated actions, int64 [B]."""
Words: TypeAlias = NDArray[np.uint64]
"""Sets of small numbers, 64 to a word."""
Randomness: TypeAlias = np.random.Generator | Keys
"""A Generator, or keys uint64 [B], one per row, so that no row's sample depends on another row."""
Progress: TypeAlias = Callable[[float], None]
"""Called with the completed share of the work, 0 ... 1."""
Reward: TypeAlias = Callable[[States, Actions, States], Floats]
"""``reward(states int64 [M, F], actions int64 [M], next_states int64 [M, F]) -> float64 [M]``, finite."""
