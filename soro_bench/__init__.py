"""soro_bench: MuJoCo benchmark environments for soft robots, with domain randomisation.

Importing the package registers its environments with Gymnasium.
"""

import os
import sys
from ctypes.util import find_library

# MuJoCo picks its OpenGL platform at import; without a display only EGL can draw. Where EGL is missing, MuJoCo would
# not even be imported with it.
if (
    sys.platform.startswith("linux")
    and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    and find_library("EGL")
):
    os.environ.setdefault("MUJOCO_GL", "egl")

from soro_bench.registration import ENV_IDS, register_envs

__version__ = "0.1.0"
__all__ = ["ENV_IDS", "__version__"]

register_envs()
