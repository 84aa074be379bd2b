"""Growth of the chambers of each walker mesh, calibrated to equal shapes; and how far the meshes still differ.

    python benchmarks/walker_calibration.py

Without gravity and floor: the curl of one inflated leg (how far its tip has come down, seen from the rear half) and the
arch of the inflated centre (height of the middle above the leg tips). The coarse mesh's growth is given; that of the
others follows so that at full inflation both heights are equal. Prints the growths for GROWTH in
soro_bench/models/walker.py and writes heights over inflation to docs/results/measured.json and
docs/images/walker_shapes.png.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.files import read_json, replacing, write_json
from soro_bench.models import walker
from soro_bench.models.simulation import Simulation
from soro_bench.models.walker_mesh import CHAMBERS, RESOLUTIONS, TIP_INNER, TIP_OUTER, build_mesh
from soro_bench.parameters import ParameterSet
from soro_bench.plotting import pyplot

DOCS = Path(__file__).parents[1] / "docs"
RAMP, SETTLE = 2.0, 1.0  # s
LEVELS = np.linspace(0, 1, 6)[1:]  # inflations
LEG = CHAMBERS.index("front_left")
SCENE = "multigait.xml"


Growth = tuple[float, float]  # of the centre, and of a leg


class FreeBody:
    """The walker without gravity and floor."""

    def __init__(self, mesh: str):
        self._mesh = mesh
        self._model = walker.build_spec(SCENE, mesh).compile()
        self._model.opt.gravity[:] = 0
        self._model.geom("floor").contype[:] = self._model.geom("floor").conaffinity[:] = 0
        self._rest = build_mesh(RESOLUTIONS[mesh]).nodes
        maps = [walker.WalkerParameters(self._model, SCENE, mesh)]
        self._sim = Simulation(self._model, ParameterSet(*walker.PARAMETERS), maps, 1)

    def nodes(self, chamber: int, growth: Growth, inflation: float = 1.0) -> np.ndarray:
        """(N, 3) m, the nodes at rest with one chamber inflated."""
        inflation_of = walker.Inflation(self._model, self._mesh, growth)
        batch, ids = self._sim.batch, np.arange(1)
        batch.reset(ids)
        target = np.zeros((1, len(CHAMBERS)))
        target[0, chamber] = inflation
        steps = round((RAMP + SETTLE) / self._model.opt.timestep)
        for k in range(steps):
            now = target * min(1.0, (k + 1) * self._model.opt.timestep / RAMP)
            batch.plastic[:, inflation_of.columns] = inflation_of.plastic(now)
            batch.step(ids)
        return self._rest + batch.qpos[0].reshape(-1, 3)

    def curl(self, growth: Growth, inflation: float = 1.0) -> float:
        """m, how far the tip of one inflated leg has come down, seen from the rear half."""
        now = self.nodes(LEG, growth, inflation)
        rear = self._rest[:, 0] < -1e-6
        seen = _in_frame_of(now, self._rest, rear)
        tip = _tips(self._rest) & (self._rest[:, 0] > 0) & (self._rest[:, 1] > 0)
        return float((self._rest[tip, 2] - seen[tip, 2]).mean())

    def arch(self, growth: Growth, inflation: float = 1.0) -> float:
        """m, height of the middle above the leg tips with the centre inflated."""
        now = self.nodes(CHAMBERS.index("centre"), growth, inflation)
        middle, tips = np.abs(self._rest[:, 0]) < 1e-6, _tips(self._rest)
        return float(now[middle, 2].mean() - now[tips, 2].mean())


def _tips(rest: np.ndarray) -> np.ndarray:
    """Nodes on the end of a leg."""
    along = (TIP_OUTER - TIP_INNER) / np.linalg.norm(TIP_OUTER - TIP_INNER)
    offset = np.abs(rest[:, :2]) - TIP_INNER
    return np.abs(offset[:, 0] * along[1] - offset[:, 1] * along[0]) < 1e-6


def _in_frame_of(now: np.ndarray, rest: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The nodes turned and moved so that the chosen ones lie as near their rest as can be (Kabsch)."""
    a, b = now[chosen].mean(axis=0), rest[chosen].mean(axis=0)
    u, _, vt = np.linalg.svd((now[chosen] - a).T @ (rest[chosen] - b))
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return (now - a) @ turn + b


def _arch(body: FreeBody, centre: float) -> float:
    return body.arch((centre, 0.0))


def _curl(body: FreeBody, leg: float) -> float:
    return body.curl((0.0, leg))


def calibrate(height: Callable[[float], float], target: float, start: float) -> float:
    """The growth at which height(growth) = target, by the secant method to 0.05 mm."""
    a, b = start, 1.1 * start
    fa, fb = height(a) - target, height(b) - target
    while abs(fb) > 5e-5:
        a, b, fa = b, b - fb * (b - a) / (fb - fa), fb
        fb = height(b) - target
    return b


def main() -> None:
    # no options, but it writes files of this repository: --help must not
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    reference = FreeBody("coarse")
    growth = {"coarse": walker.GROWTH["coarse"]}
    arch, curl = reference.arch(growth["coarse"]), reference.curl(growth["coarse"])
    print(f"coarse: growth {growth['coarse']}, arch {1e3 * arch:.2f} mm, curl {1e3 * curl:.2f} mm", flush=True)
    bodies = {"coarse": reference}
    for mesh in ("fine", "finest"):
        body = bodies[mesh] = FreeBody(mesh)
        centre = calibrate(partial(_arch, body), arch, walker.GROWTH[mesh][0])
        leg = calibrate(partial(_curl, body), curl, walker.GROWTH[mesh][1])
        growth[mesh] = (round(centre, 4), round(leg, 4))
        print(f"{mesh}: growth {growth[mesh]}", flush=True)
    shapes = {}
    for mesh, body in bodies.items():
        shapes[mesh] = {
            "growth": growth[mesh],
            "inflation": LEVELS.tolist(),
            "arch_mm": [round(1e3 * body.arch(growth[mesh], level), 3) for level in LEVELS],
            "curl_mm": [round(1e3 * body.curl(growth[mesh], level), 3) for level in LEVELS],
        }
        print(mesh, shapes[mesh], flush=True)
    results = DOCS / "results" / "measured.json"
    write_json(results, read_json(results) | {"walker_shapes": shapes})
    plot(shapes)


def plot(shapes: dict[str, dict[str, Any]]) -> None:
    plt = pyplot()
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained", sharex=True)
    for ax, what in zip(axes, ("arch", "curl"), strict=True):
        for mesh, shape in shapes.items():
            ax.plot([0, *shape["inflation"]], [0, *shape[f"{what}_mm"]], "o-", ms=3, label=mesh)
        ax.set(xlabel="inflation", ylabel=f"{what} [mm]")
        ax.grid(alpha=0.3)
    axes[0].legend(frameon=False)
    with replacing(DOCS / "images" / "walker_shapes.png") as temporary:
        figure.savefig(temporary, format="png", dpi=150, metadata={"Software": None})


if __name__ == "__main__":
    main()
