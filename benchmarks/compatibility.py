"""Which libraries run on the environments: each row of a table is a short training or a test run, in a virtual
environment that pip fills for it.

    python benchmarks/compatibility.py --venvs FOLDER [--cleanrl FOLDER] [--only ROW ...] [--out FILE]

A row that has its result, FOLDER/results/ROW.json, is not run again. CleanRL's scripts are not part of this repository:
they are cloned from their public one, or read from the folder given. The torch that this uses is the CPU build of
constraints.txt; a machine needs about 8 GB for the virtual environments. docs/generate.py writes the table.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import time
import venv
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from soro_bench.files import read_json, write_json

CHECKOUT = Path(__file__).parents[1]
CLEANRL = "https://github.com/vwxyzjn/cleanrl"
LIMIT = 1800  # s for a row
(TORCH,) = re.findall(r"(?m)^torch==.*$", (CHECKOUT / "constraints.txt").read_text())
SHOWN = ("gymnasium", "torch", "numpy", "mujoco")  # versions that every row records


@dataclass(frozen=True)
class Row:
    """What to install and run; ``script`` is a file of this folder, or of CleanRL, or tests for pytest."""

    name: str
    library: str
    packages: tuple[str, ...]
    script: str
    arguments: tuple[str, ...] = ()
    venv: str = ""  # of another row that needs the same packages
    versions: tuple[str, ...] = ()  # packages whose versions are recorded too
    note: str = ""


SB3 = ("stable-baselines3", "gymnasium>=1.4", "moviepy", TORCH)
PROGRAMS = (
    Row("checkers", "environment checkers", SB3, "library_programs.py", ("checkers",), "stable-baselines3",
        ("stable-baselines3",)),
    Row("stable-baselines3", "Stable-Baselines3", SB3, "library_programs.py", ("stable-baselines3",),
        versions=("stable-baselines3",)),
    Row("torchrl", "TorchRL", ("torchrl", "gymnasium>=1.4", TORCH), "library_programs.py", ("torchrl",),
        versions=("torchrl", "tensordict"),
        note='vector modes other than "Disabled" need `flat_info=True`; TorchRL refuses "NextStep"'),
    Row("tianshou", "Tianshou", ("tianshou[eval]", "gymnasium>=1.4", TORCH), "library_programs.py", ("tianshou",),
        versions=("tianshou",), note="its high-level interface needs the extra `eval`"),
    Row("rllib", "RLlib", ("ray[rllib]", TORCH), "library_programs.py", ("rllib",), versions=("ray",),
        note="pins Gymnasium"),
    Row("wrappers", "Gymnasium's wrappers",
        ("gymnasium>=1.4", "moviepy", "opencv-python-headless", "pygame", "matplotlib", "array-api-compat", TORCH),
        "library_programs.py", ("wrappers",), versions=("moviepy",)),
)  # fmt: skip

OF_CLEANRL = ("gymnasium==0.29.1", "tyro", "tensorboard", TORCH)
CLEANRL_ROWS = (
    Row("cleanrl-ppo", "CleanRL's ppo.py", OF_CLEANRL, "ppo.py",
        ("--env-id", "soro_bench:TrunkReach-v0", "--num-envs", "2", "--num-steps", "64", "--total-timesteps", "512"),
        "cleanrl", note="as it is, on the default model"),
    Row("cleanrl-ppo-continuous", "CleanRL's ppo_continuous_action.py", OF_CLEANRL, "ppo_continuous_action.py",
        ("--env-id", "soro_bench:TrunkReachContinuous-v0", "--num-steps", "256", "--total-timesteps", "512"),
        "cleanrl", note="as it is, on the default model; needs Gymnasium before 1.0"),
)  # fmt: skip

TESTS = {
    "0.29.1": ("test_envs.py",),
    "1.0.0": ("test_envs.py", "test_libraries.py"),
    **{each: ("test_envs.py", "test_libraries.py", "test_vector.py") for each in ("1.1.1", "1.2.3", "1.3.0", "1.4.0")},
}
TEST_ROWS = tuple(
    Row(f"gymnasium-{release}", f"Gymnasium {release}", (f"gymnasium=={release}", "pytest"), "pytest", tests,
        note="" if len(tests) == 3 else "single environments only" if release < "1" else
        "its own vector environments, with which tests compare, have one autoreset mode")
    for release, tests in TESTS.items()
)  # fmt: skip
ROWS = (*PROGRAMS, *CLEANRL_ROWS, *TEST_ROWS)


@dataclass
class Result:
    """What a row gave; ``versions`` by package, ``did`` in words."""

    name: str
    library: str
    ok: bool
    did: list[str]
    steps: int  # of environments; 0 where tests ran
    versions: dict[str, str]
    seconds: float
    note: str = ""
    details: dict[str, list[str]] = field(default_factory=dict)


def prepared(row: Row, folder: Path) -> Path:
    """The Python of a row's virtual environment, with its packages and this checkout."""
    home = folder / (row.venv or row.name)
    python = home / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not python.exists():
        venv.create(home, with_pip=True)
    command: list[str | Path] = [python, "-m", "pip", "install", "--quiet", *row.packages, "-e", CHECKOUT]
    subprocess.run(command, check=True, timeout=LIMIT)
    return python


def command_of(row: Row, python: Path, cleanrl: Path | None, folder: Path) -> list[str | Path]:
    """What runs a row."""
    if row.script == "pytest":
        tests = [CHECKOUT / "tests" / name for name in row.arguments]
        options = ("-p", "no:cacheprovider", "-k", "not flex", f"--rootdir={CHECKOUT}", "--no-header")
        return [python, "-m", "pytest", *options, *tests]
    if row in CLEANRL_ROWS:
        return [python, cleanrl_script(row.script, cleanrl, folder), *row.arguments, "--no-cuda"]
    return [python, CHECKOUT / "benchmarks" / row.script, *row.arguments]


def cleanrl_script(name: str, given: Path | None, folder: Path) -> Path:
    """A script of CleanRL, from the folder given or a clone; SystemExit says what to do if neither has it."""
    scripts = given or folder / "cleanrl-source"
    if given is None and not scripts.exists():
        clone = subprocess.run(["git", "clone", "--quiet", "--depth", "1", CLEANRL, scripts])
        if clone.returncode:
            raise SystemExit(f"{CLEANRL} cannot be cloned here; give its scripts with --cleanrl FOLDER")
    for path in (scripts / name, scripts / "cleanrl" / name):
        if path.is_file():
            return path
    raise SystemExit(f"{scripts} has no {name}; --cleanrl FOLDER names a folder with CleanRL's scripts")


def run(row: Row, folder: Path, cleanrl: Path | None) -> Result:
    """Install and run a row."""
    python = prepared(row, folder)
    listed = subprocess.run(
        [python, "-m", "pip", "list", "--format=json"], capture_output=True, text=True, check=True
    ).stdout
    installed = {each["name"].lower().replace("_", "-"): each["version"] for each in json.loads(listed)}
    versions = {name: installed[name] for name in (*row.versions, *SHOWN) if name in installed}
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"OMP_NUM_THREADS": "1", "MUJOCO_GL": "egl", "SDL_VIDEODRIVER": "dummy"}
    work = folder / "work" / row.name  # where libraries leave their files
    work.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    done = subprocess.run(
        command_of(row, python, cleanrl, folder), cwd=work, env=environment, capture_output=True, text=True,
        timeout=LIMIT,
    )  # fmt: skip
    (work / "output.txt").write_text(done.stdout + done.stderr)
    found: dict[str, Any] = outcome(row, done.stdout) if done.returncode == 0 else {"did": [], "steps": 0}
    details = {key: found[key] for key in ("left_out", "warnings") if found.get(key)}
    if row in CLEANRL_ROWS:
        script = cleanrl_script(row.script, cleanrl, folder).read_bytes()
        details["sha256 of the script"] = [hashlib.sha256(script).hexdigest()]
    seconds = round(time.monotonic() - start, 1)
    ok = done.returncode == 0
    return Result(row.name, row.library, ok, found["did"], found["steps"], versions, seconds, row.note, details)


def outcome(row: Row, printed: str) -> dict:
    """What a row that succeeded has printed of itself."""
    if row.script == "pytest":
        count = re.findall(r"(\d+) passed", printed)[-1]
        return {"did": [f"{count} tests of {', '.join(row.arguments)}"], "steps": 0}
    if row in CLEANRL_ROWS:
        steps = int(row.arguments[row.arguments.index("--total-timesteps") + 1])
        episodes = len(re.findall(r"episodic_return", printed))
        return {"did": [f"PPO, {episodes} episodes finished"], "steps": steps}
    return json.loads(printed.splitlines()[-1])


def main() -> None:
    """Run the rows that have no result yet, and write them all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--venvs", type=Path, required=True, help="folder for virtual environments and results")
    parser.add_argument("--cleanrl", type=Path, help="folder with CleanRL's scripts")
    parser.add_argument("--only", nargs="+", choices=[row.name for row in ROWS], help="rows to run")
    parser.add_argument("--out", type=Path, default=CHECKOUT / "docs" / "results" / "measured.json")
    options = parser.parse_args()
    folder = options.venvs.resolve()
    results = folder / "results"
    results.mkdir(parents=True, exist_ok=True)
    cleanrl = options.cleanrl and options.cleanrl.resolve()
    for row in ROWS:
        path = results / f"{row.name}.json"
        if path.exists() or (options.only and row.name not in options.only):
            continue
        print(f"{row.name} ...", flush=True)
        result = run(row, folder, cleanrl)
        where = folder / "work" / row.name / "output.txt"
        print(f"{row.name}: {'runs' if result.ok else f'FAILS, see {where}'}", flush=True)
        if result.ok:
            path.write_text(json.dumps(asdict(result), indent=1) + "\n")
    done = [json.loads(path.read_text()) for row in ROWS if (path := results / f"{row.name}.json").exists()]
    write_json(options.out, (read_json(options.out) if options.out.exists() else {}) | {"compatibility": done})
    print(f"{len(done)} of {len(ROWS)} rows in {options.out}")
    if len(done) < len(ROWS) and not options.only:
        sys.exit(1)


if __name__ == "__main__":
    main()
