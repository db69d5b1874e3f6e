"""A command for tests of sweeps: ``toy_sweep.py -m how=well,user``: jobs that end in different ways."""

import json
import os
import signal
import sys
import time
from pathlib import Path

from ghpt.app import run
from ghpt.errors import GhptConfigError


def task(config, output):
    match config["how"]:
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
            time.sleep(60)
    return {"pid": os.getpid()}


def after(jobs):
    told = [{"name": j.name, "how": j.config.get("how"), "result": j.result, "failed": j.failed} for j in jobs]
    print("after", json.dumps({"pid": os.getpid(), "jobs": told}))


if __name__ == "__main__":
    if "hydra/launcher=submitit_local" in sys.argv:
        import submitit

        submitit.Job._results_timeout_s = 0  # a local disk shows at once what a killed job has left
    run(Path(os.environ["TOY_CONF"]), "toy", task, lambda result: "done", after)
