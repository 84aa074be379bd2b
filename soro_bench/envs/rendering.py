"""Pictures of a task's first simulation."""

import time

import mujoco

from soro_bench.models.simulation import Simulation

_HEIGHT, _WIDTH = 480, 640
_HINT = "rendering needs OpenGL; on a machine without a display set MUJOCO_GL=egl (or osmesa) before Python starts"


def make_renderer(sim: Simulation, render_mode: str, fps: float):
    """The renderer of ``render_mode``, "human" (``fps`` pictures a second at most) or "rgb_array"."""
    return _Viewer(sim, fps) if render_mode == "human" else _Camera(sim)


class _Snapshot:
    """The first simulation's model and data, refreshed on demand."""

    def __init__(self, sim: Simulation):
        self._sim = sim
        self.model = sim.batch.get_model(0)
        self.data = mujoco.MjData(self.model)

    def update(self):
        self._sim.batch.get_model(0, self.model)
        self._sim.batch.get_data(0, self.data)
        mujoco.mj_fwdPosition(self.model, self.data)


class _Camera:
    def __init__(self, sim):
        self._snapshot = _Snapshot(sim)
        try:
            self._renderer = mujoco.Renderer(self._snapshot.model, _HEIGHT, _WIDTH)
        except (mujoco.FatalError, ImportError, RuntimeError) as error:  # by what of OpenGL is missing
            raise RuntimeError(_HINT) from error
        self._camera = self._snapshot.model.camera("review").id

    def render(self):
        self._snapshot.update()
        self._renderer.update_scene(self._snapshot.data, camera=self._camera)
        return self._renderer.render()

    def close(self):
        self._renderer.close()


class _Viewer:
    def __init__(self, sim, fps):
        import glfw
        import mujoco.viewer

        if not glfw.init():  # MuJoCo's viewer would end the process
            raise RuntimeError("render_mode='human' needs a display; use 'rgb_array' on a machine without one")
        self._snapshot = _Snapshot(sim)
        self._viewer = mujoco.viewer.launch_passive(self._snapshot.model, self._snapshot.data)
        self._interval, self._due = 1 / fps, 0.0

    def render(self):
        if self._viewer.is_running():
            time.sleep(max(0.0, self._due - time.monotonic()))  # in real time: the robot is faster than that
            self._due = time.monotonic() + self._interval
            with self._viewer.lock():
                self._snapshot.update()
            self._viewer.sync()

    def close(self):
        self._viewer.close()
