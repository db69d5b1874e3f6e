"""Testing streams: its memory does not grow with the number of frames."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

STATUS = Path("/proc/self/status")
FRAMES = 2100
"""More than the report reads at a time, which is the most it ever holds."""
BATCH = 250
ENVIRONMENT = {
    "PYTHONPATH": str(Path(__file__).parent),
    "OMP_NUM_THREADS": "1",
    # else what glibc keeps for later use differs from run to run by more than a leak
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_MMAP_THRESHOLD_": "65536",
}


def private_memory() -> float:
    """MiB that the process itself holds, without mapped files."""
    return next(
        int(line.split()[1]) / 1024
        for line in STATUS.read_text(encoding="utf-8").splitlines()
        if line.startswith("RssAnon")
    )


def child(folder: str, frames: int) -> None:
    """Test a checkpoint on ``frames`` frames and print the peak of the private memory meanwhile."""
    import numpy as np

    import toys

    class Longer(toys.ToyData):
        def generate(self, split):
            rng = np.random.default_rng(0)
            for take in range(frames // FRAMES):
                yield toys.recording(
                    f"S{take}/Walking-1", f"S{take % 2}", FRAMES, self.views, self.missing, rng
                )

        def cache_key(self, split):
            return super().cache_key(split) | {"frames": frames}

    toys.Longer = Longer
    data = toys.DATA | {
        "_target_": "toys.Longer",
        "stride": 1,
        "batch_size": BATCH,
        "cache": folder,
    }
    baselines = {"linear": {"_target_": "ghpt.models.estimators.classical.Linear"}}
    config = toys.TRAIN | {
        "data": data,
        "ckpt": f"{folder}/last.ckpt",
        "hypotheses": None,
        "baselines": baselines,
    }
    peak = [0.0]

    def watch() -> None:
        while True:
            peak[0] = max(peak[0], private_memory())
            time.sleep(0.005)

    threading.Thread(target=watch, daemon=True).start()
    metrics = toys.run_test(config, Path(folder) / str(frames)).metrics
    print(json.dumps({"peak": peak[0], "frames": metrics["frames"]}))


@pytest.mark.skipif(not STATUS.is_file(), reason="needs Linux's /proc")
def test_testing_holds_one_batch_however_many_frames(tmp_path):
    import toys
    from toys import train

    train(toys.TRAIN, tmp_path)
    peaks = []
    for times in (1, 6):
        command = [sys.executable, __file__, str(tmp_path), str(times * FRAMES)]
        run = subprocess.run(
            command, env=os.environ | ENVIRONMENT, check=True, capture_output=True, timeout=300
        )
        result = json.loads(run.stdout.splitlines()[-1])
        assert result["frames"] == times * FRAMES
        peaks.append(result["peak"])
    # The nine selections' poses of all frames, if they were kept, would be 19 MiB more.
    assert peaks[1] - peaks[0] < 12, f"{peaks} MiB"


if __name__ == "__main__":
    child(sys.argv[1], int(sys.argv[2]))
