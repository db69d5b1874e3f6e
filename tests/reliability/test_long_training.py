"""E3 and B8: a long training holds what it held at its start, and a kill leaves no process and
loses no logged step.
"""

import json
import multiprocessing
import os
import sys
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import children
import memory
import sizes

TENSORBOARD = "ghpt.report.logger.ForgivingTensorBoard"


def held() -> dict[str, float]:
    """MiB of private memory, open files, threads and processes; what glibc keeps of freed memory is
    given back.
    """
    memory.trim()
    return {
        "memory": memory.private_memory(),
        "files": len(os.listdir("/proc/self/fd")),
        "threads": memory.threads(),
        "children": len(multiprocessing.active_children()),
    }


def child(folder: str, steps: int) -> None:
    """Train until killed; print what is held after a third of the steps and after all, and the
    worker's number.
    """
    import lightning as L

    import toys
    from ghpt.commands import train as training

    class Probe(L.Callback):
        def on_train_batch_end(self, trainer, *_):
            if trainer.global_step in (steps // 3, steps):
                workers = [process.pid for process in multiprocessing.active_children()]
                print(
                    json.dumps({"held": held(), "workers": workers, "step": trainer.global_step}),
                    flush=True,
                )

    memory.keep_no_freed_memory()
    training.progress = lambda shown: [Probe()]
    data = toys.DATA | {"batch_size": 1, "workers": 1}
    model = toys.MODEL | {"hypotheses": 4, "scorer": toys.MODEL["scorer"] | {"layers": [4]}}
    trainer = toys.TRAINER | {"max_epochs": 10_000_000, "check_val_every_n_epoch": 50}
    logger = {"tensorboard": {"_target_": TENSORBOARD, "_partial_": True}}
    changes = {"data": data, "model": model, "trainer": trainer, "logger": logger}
    toys.train(toys.TRAIN | changes, Path(folder))


def gone(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status")
    return not status.exists() or "State:\tZ" in status.read_text(encoding="utf-8")


@pytest.mark.skipif(not memory.STATUS.is_file(), reason="needs Linux's /proc")
def test_e3_and_b8_a_long_training(tmp_path, record_row):
    steps = sizes.TRAINING_STEPS
    run = children.start(__file__, tmp_path, steps)
    start, end = (json.loads(run.stdout.readline()) for _ in range(2))
    run.kill()
    run.wait(children.LIMIT)
    children.wait_until(lambda: all(gone(pid) for pid in end["workers"]))
    growth = end["held"].pop("memory") - start["held"].pop("memory")
    (events,) = tmp_path.glob("*tfevents*")
    log = EventAccumulator(str(events), size_guidance={"scalars": 0}).Reload()
    logged = max(event.step for event in log.Scalars("train/total"))
    lost = max(0, end["step"] - 1 - logged)  # Lightning counts from 0
    figure = f"{steps - steps // 3} steps: {growth:+.2f} MiB, {end['held']}, 0 orphans"
    record_row("E3", figure, 1, 1)
    record_row(
        "B8", f"killed after step {end['step']}: {lost} logged steps lost", int(lost <= 1), 1
    )
    assert end["workers"]
    assert start["held"] == end["held"]
    assert growth <= 1.0
    assert lost <= 1


if __name__ == "__main__":
    child(sys.argv[1], int(sys.argv[2]))
