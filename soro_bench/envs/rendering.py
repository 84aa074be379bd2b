"""Pictures of a task's simulations."""

import time

import mujoco
import numpy as np
from numpy.typing import NDArray

from soro_bench.models.simulation import Simulation

Picture = NDArray[np.uint8]  # (height, width, 3)
_HEIGHT, _WIDTH = 480, 640
_HINT = "rendering needs OpenGL; on a machine without a display set MUJOCO_GL=egl (or osmesa) before Python starts"


def make_renderer(sim: Simulation, render_mode: str, fps: float) -> "Camera | Viewer":
    """The renderer of ``render_mode``, "human" (``fps`` pictures a second at most) or "rgb_array"."""
    return Viewer(sim, fps) if render_mode == "human" else Camera(sim)


class _Snapshot:
    """A simulation's model and data, refreshed on demand."""

    def __init__(self, sim: Simulation):
        self._sim = sim
        self.model = sim.batch.get_model(0)
        self.data = mujoco.MjData(self.model)

    def update(self, row: int = 0) -> None:
        """Take over the present state of simulation ``row``."""
        self._sim.batch.get_model(row, self.model)
        self._sim.batch.get_data(row, self.data)
        mujoco.mj_fwdPosition(self.model, self.data)


class Camera:
    """Draws what the scene's review camera sees."""

    def __init__(self, sim: Simulation):
        self._snapshot = _Snapshot(sim)
        try:
            self._renderer = mujoco.Renderer(self._snapshot.model, _HEIGHT, _WIDTH)
        except (mujoco.FatalError, ImportError, RuntimeError) as error:  # by what of OpenGL is missing
            raise RuntimeError(_HINT) from error
        self._camera = self._snapshot.model.camera("review").id

    def render(self, row: int = 0) -> Picture:
        """A picture of the present state of simulation ``row``."""
        self._snapshot.update(row)
        self._renderer.update_scene(self._snapshot.data, camera=self._camera)
        return self._renderer.render()

    def close(self) -> None:
        """Give back the OpenGL context."""
        self._renderer.close()


class Viewer:
    """MuJoCo's viewer, a window, which shows the simulation in real time."""

    def __init__(self, sim: Simulation, fps: float):
        import glfw
        import mujoco.viewer

        if not glfw.init():  # MuJoCo's viewer would end the process
            raise RuntimeError("render_mode='human' needs a display; use 'rgb_array' on a machine without one")
        self._snapshot = _Snapshot(sim)
        self._viewer = mujoco.viewer.launch_passive(self._snapshot.model, self._snapshot.data)
        self._interval, self._due = 1 / fps, 0.0

    def render(self) -> None:
        """Show the present state, once the last one was shown for long enough."""
        if self._viewer.is_running():
            time.sleep(max(0.0, self._due - time.monotonic()))  # in real time: the robot is faster than that
            self._due = time.monotonic() + self._interval
            with self._viewer.lock():
                self._snapshot.update()
            self._viewer.sync()

    def close(self) -> None:
        """Close the window."""
        self._viewer.close()
