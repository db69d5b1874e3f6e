"""Peak memory of training and of testing, each a process of its own: ``python
benchmarks/memory.py`` (Linux).

Training is ``train.py data=cmu2 model=pose`` as typed: once with the preparation of the synthetic
data, once from the cache. Testing runs that checkpoint with all baselines on synthetic recordings
of growing length; the slope says what a frame more costs. ``private`` is what the process itself
holds; the whole also counts the pages of the memory-mapped recordings that were touched, which the
system takes back when it needs them.

Settings: ``frames=1000,8000`` ``hypotheses=20`` (few, since the pools' memory is that of one
batch).
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def peak(command: list[str], **environment: str) -> tuple[float, float, float]:
    """Peak of a process's whole and private memory, MiB, and its seconds."""
    start = time.perf_counter()
    whole = 0
    private = 0
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        process = subprocess.Popen(
            [sys.executable, *command],
            cwd=ROOT,
            env=os.environ | environment,
            stdout=nowhere,
            stderr=subprocess.PIPE,
        )
    while process.poll() is None:
        fields = _status(process.pid)
        whole = max(whole, fields.get("VmHWM", 0))
        private = max(private, fields.get("RssAnon", 0))
        time.sleep(0.01)
    if process.returncode:
        sys.exit(f"{' '.join(command)} failed:\n{process.stderr.read().decode()[-2000:]}")
    return whole / 1024, private / 1024, time.perf_counter() - start


def _status(pid: int) -> dict[str, int]:
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:  # it has just ended
        return {}
    return {
        name: int(value.split()[0])
        for name, value in (line.split(":", 1) for line in lines)
        if "kB" in value
    }


def test_scene(checkpoint: str, folder: str, frames: int, hypotheses: int) -> None:
    """In a process of its own: test on ``frames`` synthetic frames of 4 views."""
    import scene
    from measure import configuration

    from ghpt.commands.test import TestSettings, test
    from ghpt.config import settings

    config = configuration(
        "test", "progress_bar=false", f"ckpt={checkpoint}", f"hypotheses={hypotheses}"
    )
    lengths = {"train": 16, "validation": 16, "test": frames}
    config["data"] = scene.DATA | {"cache": folder, "views": 4, "frames": lengths}
    config["trainer"] |= {"accelerator": "cpu", "devices": 1}
    output = Path(folder) / f"test-{frames}"
    test(settings(TestSettings, config | {"output": str(output)}), output)


def main() -> None:
    from measure import machine, settings, show

    wanted = settings(frames="1000,8000", hypotheses=20)
    title = machine()
    lengths = [int(n) for n in wanted["frames"].split(",")]
    with tempfile.TemporaryDirectory() as folder:
        train = [
            "train.py",
            "data=cmu2",
            "model=pose",
            "progress_bar=false",
            f"output={folder}/train",
        ]
        measured = {}
        for name in ("train.py, data prepared", "train.py, data cached"):
            measured[name] = peak(train, GHPT_CACHE=f"{folder}/cache", CUDA_VISIBLE_DEVICES="")
        for count in lengths:
            again = [
                __file__,
                "test",
                f"{folder}/train/last.ckpt",
                folder,
                str(count),
                str(wanted["hypotheses"]),
            ]
            measured[f"test, {count:,} frames"] = peak(again)
        rows = [[name, f"{a:.0f}", f"{b:.0f}", f"{t:.0f}"] for name, (a, b, t) in measured.items()]
        first, last = (measured[f"test, {count:,} frames"] for count in (lengths[0], lengths[-1]))
        slopes = [
            100_000 * (b - a) / (lengths[-1] - lengths[0])
            for a, b in zip(first[:2], last[:2], strict=True)
        ]
        rows.append(["growth in MiB per 100,000 frames", *(f"{slope:.0f}" for slope in slopes), ""])
    show(title, ["peak memory, MiB", "whole", "private", "seconds"], rows)


if __name__ == "__main__":
    if sys.argv[1:2] == ["test"]:
        test_scene(sys.argv[2], sys.argv[3], int(sys.argv[4]), int(sys.argv[5]))
    else:
        main()
