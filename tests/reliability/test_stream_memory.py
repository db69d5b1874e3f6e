"""E2: the memory of a prediction does not grow with the recording."""

import sys
from pathlib import Path

import children
import memory
import sizes


def child(output: str, frames: int) -> None:
    """Predict so many frames; print by how much the last third held more than the one before, and
    the most that was held, MiB.
    """
    from ghpt.commands import predict as command
    from ghpt.commands.prediction import run, sequences
    from predicting import config, sequence_of

    held = []
    write = run.Shards.write

    def measured(self, shard, part):
        write(self, shard, part)
        memory.trim()
        held.append(memory.private_memory())

    run.Shards.write = measured
    sequences.recording_sequence = lambda _: sequence_of(frames)
    words = ("estimator=linear", "shard_frames=2000", "batch=1000", "formats=[npz,csv]")
    command.predict(config(*words), Path(output))
    third = len(held) // 3
    print("figures", max(held[-third:]) - max(held[third:-third]), memory.peak_memory())


def test_e2_memory_is_flat_over_the_frames(tmp_path, record_row):
    frames = sizes.STREAMED_FRAMES
    said = children.output_of(__file__, tmp_path / "out", frames)
    growth, peak = map(float, said.split("figures")[1].split())
    record_row(
        "E2",
        f"{frames} frames: {growth:.1f} MiB more in the last third than in the one before, "
        f"peak {peak:.0f} MiB",
        int(growth <= 1),
        1,
    )
    assert growth <= 1
    assert peak <= 512 + 300  # with torch itself


if __name__ == "__main__":
    child(sys.argv[1], int(sys.argv[2]))
