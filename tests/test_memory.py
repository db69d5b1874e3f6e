"""Testing streams: its memory does not grow with the number of frames."""

import json
import sys
import threading
import time
from pathlib import Path

import pytest

import children
import memory

FRAMES = 2100
"""More than the report reads at a time, which is the most it ever holds."""
BATCH = 250


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

    memory.keep_no_freed_memory()
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
        "hypotheses": 4,
        "baselines": baselines,
    }
    peak = [0.0]

    def watch() -> None:
        while True:
            peak[0] = max(peak[0], memory.private_memory())
            time.sleep(0.005)

    threading.Thread(target=watch, daemon=True).start()
    metrics = toys.run_test(config, Path(folder) / str(frames)).measured.plain()
    print(json.dumps({"peak": peak[0], "frames": metrics["frames"]}))


@pytest.mark.skipif(not memory.STATUS.is_file(), reason="needs Linux's /proc")
def test_testing_holds_one_batch_however_many_frames(tmp_path):
    import toys
    from toys import train

    train(toys.TRAIN, tmp_path)
    peaks = []
    for times in (1, 4):
        said = children.output_of(__file__, tmp_path, times * FRAMES)
        result = json.loads(said.splitlines()[-1])
        assert result["frames"] == times * FRAMES
        peaks.append(result["peak"])
    # The nine selections' poses of all frames, if they were kept, would be 11 MiB more.
    assert peaks[1] - peaks[0] < 7, f"{peaks} MiB"


if __name__ == "__main__":
    child(sys.argv[1], int(sys.argv[2]))
