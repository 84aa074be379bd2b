"""Writes docs/environments/<id>.md, a page per environment, from the code: spaces, parameters and docstrings.

python docs/build_environments.py

The pictures are drawn by docs/images/environments.py.
"""

import inspect
import re
from pathlib import Path

import gymnasium

from soro_bench.envs.task import ACTION_MODES, Task
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.parameters import Parameter
from soro_bench.registration import ENV_IDS, task_type

DOCS = Path(__file__).parent
SOURCES = """The search box of what the study randomises, here or in another task, is its own; other boxes, and all \
bounds, are ours. The published boxes of Poisson's ratio go further, to where linear elasticity is singular (trunk) or \
beyond (membrane). Published values and their sources: [reference_tasks.md](../reference_tasks.md). Reasons for ours: \
the comments in [parameters.py](../../soro_bench/parameters.py)."""


def page(env_id: str) -> str:
    """The page of an environment, Markdown."""
    task = task_type(env_id)
    # the cheap model, as its spaces are those of the others and it is compiled faster
    envs = {mode: gymnasium.make(env_id, **{task.variant_name: task.cheap}, action=mode) for mode in ACTION_MODES}
    summary, sections = inspect.getdoc(type(next(iter(envs.values())).unwrapped)).split("\n", 1)
    parts = [
        "<!-- written by docs/build_environments.py -->",
        f"# {env_id}",
        f"![{env_id}](../images/{env_id}.png)",
        summary,
        overview(env_id, task, envs),
        linked(sections.strip()),
        "## Parameters",
        parameter_table(task),
        SOURCES,
        "What all environments have in common: [environments.md](../environments.md).",
    ]
    return "\n\n".join(parts) + "\n"


def overview(env_id: str, task: type[Task], envs: dict[str, gymnasium.Env]) -> str:
    """The table at the top of a page."""
    env = envs["discrete"]
    boards = {name: board for name, board in BOARDS.items() if board.env_id == env_id}
    spaces = "; ".join(f"{mode}: `{made.action_space}`" for mode, made in envs.items())
    rows = [
        ("make", f'`gymnasium.make("{env_id}")` after `import soro_bench`'),
        ("action space", spaces),
        ("observation space", f"`{env.observation_space}`"),
        ("episode", f"{env.spec.max_episode_steps} steps of {task.control_timestep:g} s"),
        ("models", f"`{task.variant_name}`: `{task.accurate}` (default, accurate), `{task.cheap}` (cheap)"),
        ("fixed evaluation", f"{len(task.evaluation)} episode{'s' * (len(task.evaluation) > 1)}"),
        *([("metric", metric(boards)), ("boards", ", ".join(f"`{name}`" for name in boards))] if boards else []),
    ]
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)])


def metric(boards: dict) -> str:
    """What the boards of an environment compare."""
    board = next(iter(boards.values()))
    better = "more" if board.higher else "less"
    return f'`info["{board.metric}"]` [m] at the end of an episode; {better} is better'


def parameter_table(task: type[Task]) -> str:
    """The parameters of a task."""
    randomized = {p.name for p in task.randomized}
    columns = ("name", "nominal", "unit", "bounds", "search box", "randomised in the study", "meaning")
    rows = [parameter_row(p, p.name in randomized) for p in task.parameters.parameters.values()]
    return "\n".join(map(line, [columns, ["---"] * len(columns), *rows]))


def parameter_row(p: Parameter, randomized: bool) -> list[str]:
    """A parameter's cells."""
    ranges = ("{:g} .. {:g}".format(*pair) for pair in (p.bounds, p.search))
    return [f"`{p.name}`", f"{p.nominal:g}", p.unit, *ranges, "yes" if randomized else "no", p.meaning]


def line(cells) -> str:
    """A row of a table."""
    return f"| {' | '.join(cells)} |"


def linked(text: str) -> str:
    """A docstring with its cross references as links."""
    text = re.sub(r":class:`(\w+)Env`", r"[\1-v0](\1-v0.md)", text)
    return re.sub(r"docs/([a-z_]+\.md)", r"[\1](../\1)", text)


def pages() -> dict[Path, str]:
    """The texts of all pages by their paths."""
    return {DOCS / "environments" / f"{env_id}.md": page(env_id) for env_id in ENV_IDS}


if __name__ == "__main__":
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
