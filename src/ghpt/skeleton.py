"""The 17 joints of Human3.6M, in the order that every array of the project uses on its J axis."""

JOINTS = (
    "right_ankle",
    "right_knee",
    "right_hip",
    "left_hip",
    "left_knee",
    "left_ankle",
    "pelvis",
    "spine",
    "thorax",
    "head_top",
    "right_wrist",
    "right_elbow",
    "right_shoulder",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "nose",
)
"""Pelvis is the middle of the hips, thorax the base of the neck. Right comes before left: the
authors' code names index 0 the left foot, but projecting Human3.6M into its images shows the right
one.
"""

JOINT = {name: index for index, name in enumerate(JOINTS)}
"""Index on the J axis by name."""

BONES = tuple(
    (JOINT[a], JOINT[b])
    for a, b in (
        ("right_ankle", "right_knee"),
        ("right_knee", "right_hip"),
        ("right_hip", "pelvis"),
        ("left_ankle", "left_knee"),
        ("left_knee", "left_hip"),
        ("left_hip", "pelvis"),
        ("pelvis", "spine"),
        ("spine", "thorax"),
        ("thorax", "head_top"),
        ("head_top", "nose"),
        ("thorax", "right_shoulder"),
        ("right_shoulder", "right_elbow"),
        ("right_elbow", "right_wrist"),
        ("thorax", "left_shoulder"),
        ("left_shoulder", "left_elbow"),
        ("left_elbow", "left_wrist"),
    )
)
"""The 16 body parts between adjacent joints (paper, section 3.1), as index pairs."""

SYMMETRIC_PARTS = {
    part: tuple(
        (JOINT[f"{side}_{a}"], JOINT[b if b == "thorax" or b == "pelvis" else f"{side}_{b}"])
        for side in ("left", "right")
    )
    for part, (a, b) in {
        "upper_arm": ("shoulder", "elbow"),
        "lower_arm": ("elbow", "wrist"),
        "shoulder": ("shoulder", "thorax"),
        "hip": ("hip", "pelvis"),
        "upper_leg": ("hip", "knee"),
        "lower_leg": ("knee", "ankle"),
    }.items()
}
"""The six (left, right) parts of the pose prior (paper, section 4.4): name -> ((a, b) left, (a, b)
right).
"""

MIRROR = tuple(
    JOINT[name.replace("left", "right") if "left" in name else name.replace("right", "left")]
    for name in JOINTS
)
"""For each joint, the joint on the other side of the body (itself on the midline)."""

SIX_JOINTS = tuple(
    JOINT[f"{side}_{joint}"] for joint in ("elbow", "wrist", "knee") for side in ("right", "left")
)
"""Elbows, wrists and knees: the joints on which Iskakov et al. report CMU -> Human3.6M."""

PELVIS = JOINT["pelvis"]
THORAX = JOINT["thorax"]
