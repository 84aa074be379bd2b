"""Copies and pickles of environments."""

import copy
from collections.abc import Callable
from typing import Any, ClassVar, Self

from soro_bench.envs.task import Task

_BUILT_AGAIN = ("task", "_renderer")  # simulations and a window or an OpenGL context, which cannot be copied


class CopiedWithTask:
    """An environment with a task, whose copies, also through a pickle, go on from its present state to the last bit.

    A copy's task is built again from the same options, effects included. A renderer is opened when it is needed.
    """

    task_type: ClassVar[type[Task]]
    task: Task
    _task_options: dict[str, Any]

    def _build_task(self) -> Task:
        """The task of the options; the effects of a file are those of this moment, also in later copies."""
        build: Callable[..., Task] = self.task_type
        task = build(**self._task_options)
        if "effects" in self._task_options:
            self._task_options["effects"] = task.effects
        return task

    def __copy__(self) -> Self:
        """A deep copy: simulations cannot be shared."""
        return copy.deepcopy(self)

    def __getstate__(self) -> dict[str, Any]:
        """What the copy begins with."""
        own = {name: value for name, value in vars(self).items() if name not in _BUILT_AGAIN}
        return {"own": own, "task": self.task.saved()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin as a copy."""
        vars(self).update(state["own"], _renderer=None)
        self.task = self._build_task()
        self.task.resume(state["task"])
