# SPDX-License-Identifier: Apache-2.0
"""The service with a network that takes at least ``SLOW_S`` seconds for each patch.

So a cloud is under way for as long as a test needs, on a fast machine too, and costs little. It
has to have 20,000 points: a cloud that is upsampled in one task does not pass here.
This file is the program, and Dask's preload in its workers.
"""

import functools
import os
import time
from typing import Any


def slow_down() -> None:
    """Let the network of this process wait before each patch."""
    from pugeo_service.engine import stages

    predict, seconds = stages.predict, float(os.environ["SLOW_S"])

    @functools.wraps(predict)
    def slow(batch: Any, model: Any) -> Any:
        time.sleep(seconds * len(batch.patches))
        return predict(batch, model)

    stages.predict = slow


def dask_setup(worker: object) -> None:
    """Slow down a worker process; Dask calls it after the preload of the service."""
    del worker
    slow_down()


if __name__ == "__main__":
    import typer

    from pugeo_service.cli import serve
    from pugeo_service.engine.dask_config import CONFIG

    CONFIG["distributed.worker.preload"].append(__file__)
    slow_down()  # for the engine of threads
    typer.run(serve)
