"""Type aliases of arrays."""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Ints: TypeAlias = npt.NDArray[np.int64]
Floats: TypeAlias = npt.NDArray[np.float64]
Bools: TypeAlias = npt.NDArray[np.bool_]
Keys: TypeAlias = npt.NDArray[np.uint64]
"""Keys of counter-based random numbers, see ``random_keys``."""
Bits: TypeAlias = npt.NDArray[np.int8]
"""A batch of observations, int8 ``[B, *shape]`` of zeros and ones."""
