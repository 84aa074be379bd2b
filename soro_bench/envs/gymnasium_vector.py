"""Gymnasium's vector environments, wherever its releases have them.

Single environments work with Gymnasium 0.29 too, which CleanRL's scripts ask for. Vector environments need 1.0.
"""

from enum import Enum
from typing import TYPE_CHECKING

import gymnasium

if TYPE_CHECKING:
    from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
else:
    try:
        from gymnasium.vector import VectorEnv, VectorWrapper
    except ImportError:  # 0.29
        from gymnasium.experimental.vector import VectorEnv, VectorWrapper
    try:
        from gymnasium.vector import AutoresetMode
    except ImportError:  # before 1.1

        class AutoresetMode(Enum):
            """When a vector environment begins the next episode, as Gymnasium 1.1 has it."""

            NEXT_STEP = "NextStep"
            SAME_STEP = "SameStep"
            DISABLED = "Disabled"


__all__ = ["AutoresetMode", "VectorEnv", "VectorWrapper", "need_vector_environments"]


def need_vector_environments() -> None:
    """ImportError if this Gymnasium is older than its present vector environments."""
    if gymnasium.__version__.startswith("0."):
        raise ImportError(f"vector environments need gymnasium 1.0 or newer; {gymnasium.__version__} is installed")
