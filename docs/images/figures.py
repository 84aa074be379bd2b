"""Draws the figures of the pages, all or those that are named.

MUJOCO_GL=egl python docs/images/figures.py [criteria] [lift] [training] [trunk] [walker]
"""

import argparse
import runpy
from collections.abc import Callable
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from PIL import Image

import soro_bench  # noqa: F401  registers the environments
from soro_bench.campaign.run import ENTRY
from soro_bench.leaderboard.entry import load_policy
from soro_bench.leaderboard.gather import gather_control
from soro_bench.leaderboard.strict import read_strict
from soro_bench.plotting import pyplot

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
RESULTS = ROOT / "leaderboard" / "results"

# --- criteria.png ---

COLORS = {True: "tab:green", False: "tab:red"}


def panel(axes, criteria, called):
    """A dot per criterion with its 95 % interval, and the threshold, black."""
    for y, each in enumerate(reversed(criteria)):
        color = COLORS[each["met"]]
        axes.plot(each["interval"], [y, y], color=color, lw=1.5)
        axes.plot(each["value"], y, "o", color=color, ms=5)
        axes.plot([each["bar"]] * 2, [y - 0.35, y + 0.35], color="black", lw=1.5)
    axes.set_yticks(range(len(criteria)), [f"{called(each)} (of {each['cases']})" for each in reversed(criteria)])
    axes.grid(axis="x", alpha=0.3)


def criteria() -> None:
    """The acceptance criteria of the last release of the diagnosis."""
    script = runpy.run_path(str(ROOT / "benchmarks" / "releases.py"))
    release = script["releases"]()[-1]
    scored = [each for each in script["scores"](release) if each["met"] is not None]
    shares = [each for each in scored if each["bar"] <= 1]  # all but the time
    least, most = ([each for each in shares if each["below"] is below] for below in (False, True))
    figure, (upper, lower) = pyplot().subplots(
        2, 1, figsize=(9, 5.4), layout="constrained", sharex=True, height_ratios=(len(least), len(most))
    )
    panel(upper, least, script["called"])
    panel(lower, most, script["called"])
    upper.set_title(f"{script['name_of'](release)}; black: the least that is allowed")
    lower.set_title("black: the most that is allowed")
    lower.set_xlabel("share of the robots")
    figure.savefig(FOLDER / "criteria.png", dpi=120)


# --- trunk.png, the README's picture ---

HEIGHT, WIDTH, OVERSAMPLING = 480, 560, 2
EYE, TARGET, FIELD_OF_VIEW = (0.31, 0.09, 0.20), (0.0, -0.05, 0.085), 38.0  # m, m, degrees
# (action, repetitions), found by random search on the cheap model; and reset options
EPISODES = {
    "TrunkReach-v0": ([(1, 4), (7, 3)], {"goal": (-0.016, -0.050, 0.115)}),
    "TrunkPush-v0": ([(1, 3), (2, 5), (3, 2), (12, 2), (3, 1), (8, 4), (9, 3)], {}),
    "TrunkLift-v0": (
        [
            (14, 2),
            (12, 10),
            (11, 3),
            (10, 2),
            (2, 2),
            (7, 1),
            (10, 1),
            (6, 4),
            (13, 3),
            (9, 6),
            (5, 6),
            (4, 5),
            (15, 2),
            (4, 1),
        ],
        {},
    ),
}


def final_state(env_id: str, actions, options) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Model and data after the episode."""
    env = gymnasium.make(env_id, model="cable")
    env.reset(seed=1, options=options)
    for action, repetitions in actions:
        for _ in range(repetitions):
            env.step(action)
    return state_of(env)


def state_of(env: gymnasium.Env) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Model and data of an environment as it is."""
    batch = env.unwrapped.task.sim.batch
    model = batch.get_model(0)
    data = mujoco.MjData(model)
    batch.get_data(0, data)
    return model, data


def aim(model: mujoco.MjModel):
    """Point the scene's camera at the trunk; y is up."""
    backward = np.subtract(EYE, TARGET)
    backward /= np.linalg.norm(backward)
    right = np.cross([0, 1, 0], backward)
    right /= np.linalg.norm(right)
    mujoco.mju_mat2Quat(model.cam_quat[0], np.column_stack([right, np.cross(backward, right), backward]).ravel())
    model.cam_pos[0], model.cam_fovy[0] = EYE, FIELD_OF_VIEW


def draw(model: mujoco.MjModel, data: mujoco.MjData) -> Image.Image:
    """The picture, drawn larger and scaled down."""
    aim(model)
    model.vis.global_.offheight, model.vis.global_.offwidth = OVERSAMPLING * HEIGHT, OVERSAMPLING * WIDTH
    model.vis.map.shadowclip = 2  # else the shadow map ends inside the picture
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, OVERSAMPLING * HEIGHT, OVERSAMPLING * WIDTH) as renderer:
        renderer.update_scene(data, camera=0)
        return Image.fromarray(renderer.render()).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


def trunk() -> None:
    """The end of one open-loop episode of each task of the trunk."""
    picture = Image.new("RGB", (len(EPISODES) * (WIDTH + 8) - 8, HEIGHT), "white")
    for i, (env_id, (actions, options)) in enumerate(EPISODES.items()):
        picture.paste(draw(*final_state(env_id, actions, options)), (i * (WIDTH + 8), 0))
    picture.save(FOLDER / "trunk.png", optimize=True)


# --- lift.png ---

MASS = 0.05  # kg
ENTRIES = ("no_dr/seed0", "no_dr/seed2", "dr/seed0")  # two kinds of what a fixed wall leads to; all random ones
SEARCHED = ROOT / "baselines" / "lift_sequences" / "cable_0.05kg_wall.json"


def by_policy(entry: str):
    """An entry's action for a step and an observation."""
    policy = load_policy(RESULTS / "TrunkLift-v0-50g" / "ppo" / f"{entry}.json")
    return lambda step, observation: policy.act(observation[None])[0]


def by_search():
    """What the search has found, whatever is observed."""
    actions = np.array(read_strict(SEARCHED)["actions"], np.float32)
    return lambda step, observation: actions[step]


def final_picture(act) -> Image.Image:
    """Of the end of an episode."""
    env = gymnasium.make("TrunkLift-v0", model="cable", action="continuous")
    observation, _ = env.reset(seed=0, options={"params": {"cube_mass": MASS}})
    for step in range(env.spec.max_episode_steps):
        observation, _, _, _, info = env.step(act(step, observation))
    print(f"elevation {1e3 * info['elevation']:.1f} mm, lowest corner {1e3 * info['clearance']:.1f} mm")
    return draw(*state_of(env))


def lift() -> None:
    """How episodes of TrunkLift end on the lumped model, by trained policies and by commands of a search."""
    acts = [*map(by_policy, ENTRIES), by_search()]
    picture = Image.new("RGB", (len(acts) * (WIDTH + 8) - 8, HEIGHT), "white")
    for i, act in enumerate(acts):
        picture.paste(final_picture(act), (i * (WIDTH + 8), 0))
    picture.save(FOLDER / "lift.png", optimize=True)


# --- walker.png ---

ROWS, COLUMNS = slice(110, 400), slice(60, 600)  # what the robot takes of a picture
SHOWN = (("coarse", []), ("coarse", [0, 0, 2]), ("fine", [0, 0, 2]))


def walker() -> None:
    """MultiGait flat, and with centre and front legs inflated on the coarse and the fine mesh."""
    pictures = []
    for mesh, actions in SHOWN:
        env = gymnasium.make("MultiGait-v0", mesh=mesh, render_mode="rgb_array")
        env.reset(seed=0)
        for action in actions:
            env.step(action)
        pictures.append(env.render()[ROWS, COLUMNS])
        env.close()
    whole = Image.fromarray(np.hstack(pictures))
    whole.resize((1080, 193), Image.LANCZOS).save(FOLDER / "walker.png", optimize=True)


# --- distances of TrunkReach and TrunkPush ---

ON_REACH = ("oracle", "rf_dropo", "bayes_sim", "bayes_sim_variance", "udr", "dr_box", "memory", "rf_dropo_cable",
            "oracle_flex")  # fmt: skip
ON_PUSH = ("oracle", "rf_dropo", "bayes_sim", "bayes_sim_variance", "udr", "dr_box", "rf_dropo_cable",
           "rf_dropo_unmodelled", "bayes_sim_unmodelled", "udr_unmodelled")  # fmt: skip


def distances(groups):
    """A panel for every model evaluated on, and in it a point for every final distance, and means."""
    labels = list(groups[0].labels)
    figure, panels = pyplot().subplots(1, len(labels), figsize=(9, 3.75), layout="constrained", sharey=True)
    rng, everything = np.random.default_rng(0), [group.scores(label) for group in groups for label in labels]
    for label, axes in zip(labels, panels, strict=True):
        for at, group in enumerate(groups):
            values = group.scores(label).ravel()
            size, alpha = (6, 0.4) if len(values) > 30 else (20, 0.7)
            axes.scatter(at + rng.uniform(-0.25, 0.25, len(values)), values, s=size, alpha=alpha, lw=0, color=f"C{at}")
            axes.plot([at - 0.35, at + 0.35], 2 * [values.mean()], color="black", lw=2)
        axes.set(title=f"on {label}", yscale="log")
        axes.set_yticks(ticks := (0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200), [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.set_ylim(0.9 * min(map(np.min, everything)), 1.1 * max(map(np.max, everything)))
        axes.set_xticks(range(len(groups)), [group.method for group in groups], rotation=30, ha="right")
        axes.grid(axis="y", alpha=0.3)
    panels[0].set(ylabel="final distance [mm]")
    return figure


def training() -> None:
    """From the leaderboard's entries."""
    boards = gather_control(RESULTS)
    reach, push = (
        {group.method: group for group in boards[board] if group.entry == ENTRY}
        for board in ("TrunkReach-v0", "TrunkPush-v0")
    )
    for name, figure in (
        ("reach_distances", distances([reach[method] for method in ON_REACH])),
        ("push_distances", distances([push[method] for method in ON_PUSH])),
    ):
        figure.savefig(FOLDER / f"{name}.png", dpi=160, metadata={"Software": None})


FIGURES: dict[str, Callable[[], None]] = {each.__name__: each for each in (criteria, lift, training, trunk, walker)}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=("all", *FIGURES), default="all", metavar="NAME")
    names = parser.parse_args().names
    for name in FIGURES if "all" in names else names:
        FIGURES[name]()
