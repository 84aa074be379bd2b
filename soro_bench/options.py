"""Options that several commands take."""

from typing import Annotated

import tyro

from soro_bench.parallel import Workers

EnvId = Annotated[str, tyro.conf.Positional]
Parallel = Annotated[Workers, tyro.conf.arg(name="")]  # --jobs, --backend, --scheduler
