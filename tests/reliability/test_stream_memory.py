"""E2: the memory of a prediction does not grow with the recording."""

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import ctypes, gc, sys
sys.path.insert(0, {tests!r})
import torch
from pathlib import Path
from predicting import config, sequence_of
from ghpt.commands import predict as command
from ghpt.commands.prediction import run

def anonymous():
    with open("/proc/self/status") as handle:
        return {{line.split(":")[0]: int(line.split()[1]) for line in handle if line.startswith(("RssAnon", "VmHWM"))}}

seen = []
write = run.Shards.write
def measured(self, shard, part):
    write(self, shard, part)
    gc.collect()
    # what glibc keeps of freed memory swings by 10 MiB from run to run: given back first, it swings by 0.2
    ctypes.CDLL(None).malloc_trim(0)
    seen.append(anonymous()["RssAnon"])
run.Shards.write = measured
command.data_sequence = lambda _: sequence_of({frames})
words = ("triangulation=linear", "shard_frames=2000", "batch=1000", "formats=[npz,csv]", "trainer.accelerator=cpu")
command.predict(config(*words), Path({output!r}))
third = len(seen) // 3
print("figures", max(seen[-third:]) - max(seen[third:-third]), anonymous()["VmHWM"])
"""


def test_e2_memory_is_flat_over_the_frames(tmp_path, nightly, record_row):
    frames = 1_000_000 if nightly else 24_000
    script = SCRIPT.format(
        tests=str(Path(__file__).parents[1]), frames=frames, output=str(tmp_path / "out")
    )
    run = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=1200
    )
    assert run.returncode == 0, run.stderr
    growth, peak = map(int, run.stdout.split("figures")[1].split())
    record_row(
        "E2",
        f"{frames} frames: {growth} KiB more in the last third than in the one before, peak {peak} KiB",
        int(growth <= 1024),
        1,
    )
    assert growth <= 1024
    assert peak <= (512 + 300) * 1024  # with torch itself
