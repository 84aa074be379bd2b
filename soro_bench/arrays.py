"""Types of arrays for annotations. Shapes and units are in the docstrings: the type system knows neither."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
