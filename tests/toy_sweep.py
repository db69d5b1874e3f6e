"""A command for tests of sweeps: ``toy_sweep.py -m how=well,user``: jobs that end in different
ways.
"""

import json
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from ghpt.commands.app import Command, run
from ghpt.commands.outputs import Files, OutputSettings
from ghpt.errors import GhptConfigError
from ghpt.files import atomic_write


@dataclass(frozen=True, kw_only=True)
class ToySettings(OutputSettings):
    how: str


def task(settings, output):
    match settings.how:
        case "once":  # fails in its first run
            if not (output / "failed").exists():
                (output / "failed").touch()
                raise GhptConfigError("how", "is once", "Say well.")
        case "user":
            raise GhptConfigError("how", "is user", "Say well.")
        case "fault":
            raise KeyError("lost")
        case "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        case "exits":
            sys.exit(143)
        case "waits":
            (output / "begun").touch()
            time.sleep(3600)
    with atomic_write(output / "pid", "w") as handle:
        handle.write(str(os.getpid()))
    return {"pid": os.getpid()}


def after(jobs):
    told = [
        {
            "name": j.name,
            "how": j.settings and j.settings.how,
            "result": j.result,
            "failed": j.failed,
        }
        for j in jobs
    ]
    print("after", json.dumps({"pid": os.getpid(), "jobs": told}))


if __name__ == "__main__":
    if "hydra/launcher=submitit_local" in sys.argv:
        import submitit

        submitit.Job._results_timeout_s = 0  # a local disk shows at once what a killed job has left
    command = Command(
        name="toy",
        settings=ToySettings,
        task=task,
        summary=lambda result: "done",
        files=lambda settings: Files(),
        after=after,
    )
    run(Path(os.environ["TOY_CONF"]), command)
