"""E4: very many files are read in time that grows with their number, and in memory that their
content needs.
"""

import json
from pathlib import Path

import numpy as np

import children
import sizes

READ = """
import resource, sys, time
from ghpt.data.formats.key_points import read_key_points
before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
people = read_key_points(sys.argv[1], "body_25")
seconds = time.process_time() - start
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
print(seconds, memory, len(people.row), people.points.pixels.nbytes)
"""


def recording(folder: Path, frames: int, padding: int) -> int:
    """Frames of one view, each so many bytes longer than it need be; their bytes together."""
    rng = np.random.default_rng(0)
    (folder / "a").mkdir(parents=True)
    total = 0
    for frame in range(frames):
        joints = np.column_stack([rng.uniform(0, 1900, (25, 2)).round(3), rng.random(25).round(4)])
        people = [
            {
                "person_id": [-1],
                "pose_keypoints_2d": joints.ravel().tolist(),
                "face_keypoints_2d": [0] * padding,
            }
        ]
        text = json.dumps({"version": 1.3, "people": people})
        (folder / "a" / f"a_{frame:012d}_keypoints.json").write_text(text)
        total += len(text)
    return total


def measured(folder: Path) -> tuple[float, float, int, int]:
    said = children.output_of("-c", READ, folder)
    seconds, grown, people, size = map(float, said.split())
    return seconds, grown / 1024, int(people), int(size)


def test_time_and_memory_grow_with_the_files(tmp_path, nightly, record_row):
    frames = sizes.MANY_FILES
    padding = 3000 if nightly else 100
    total = [recording(tmp_path / str(n), n * frames, padding) for n in (1, 2)]
    found = [
        min((measured(tmp_path / str(n)) for _ in range(1 if nightly else 2)), key=lambda f: f[0])
        for n in (1, 2)
    ]
    ratio = found[1][0] / found[0][0]
    files = f"{2 * frames} files, {total[1] / 1e9:.3f} GB"
    figure = f"{files}: {found[1][0]:.1f} s, x {ratio:.2f} for twice as many"
    record_row("E4", f"{figure}, RSS + {found[1][1]:.0f} MiB", 1, 1)
    assert found[1][2] == 2 * frames
    assert ratio < (2.2 if nightly else 3)
    assert found[1][0] <= 60
    assert found[1][1] < 64 + 8 * found[1][3] / 2**20
