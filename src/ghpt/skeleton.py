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


def _bone(start: str, end: str) -> tuple[int, int]:
    return JOINT[start], JOINT[end]


BONES = (
    _bone("right_ankle", "right_knee"),
    _bone("right_knee", "right_hip"),
    _bone("right_hip", "pelvis"),
    _bone("left_ankle", "left_knee"),
    _bone("left_knee", "left_hip"),
    _bone("left_hip", "pelvis"),
    _bone("pelvis", "spine"),
    _bone("spine", "thorax"),
    _bone("thorax", "head_top"),
    _bone("head_top", "nose"),
    _bone("thorax", "right_shoulder"),
    _bone("right_shoulder", "right_elbow"),
    _bone("right_elbow", "right_wrist"),
    _bone("thorax", "left_shoulder"),
    _bone("left_shoulder", "left_elbow"),
    _bone("left_elbow", "left_wrist"),
)
"""The 16 bones between adjacent joints (paper, section 3.1), as index pairs."""

SYMMETRIC_BONES = {
    "upper_arm": (_bone("left_shoulder", "left_elbow"), _bone("right_shoulder", "right_elbow")),
    "lower_arm": (_bone("left_elbow", "left_wrist"), _bone("right_elbow", "right_wrist")),
    "shoulder": (_bone("left_shoulder", "thorax"), _bone("right_shoulder", "thorax")),
    "hip": (_bone("left_hip", "pelvis"), _bone("right_hip", "pelvis")),
    "upper_leg": (_bone("left_hip", "left_knee"), _bone("right_hip", "right_knee")),
    "lower_leg": (_bone("left_knee", "left_ankle"), _bone("right_knee", "right_ankle")),
}
"""The six (left, right) pairs of bones of the pose prior (paper, section 4.4), by name."""


def _mirror(name: str) -> str:
    if name.startswith("left"):
        return name.replace("left", "right")
    return name.replace("right", "left")


MIRROR = tuple(JOINT[_mirror(name)] for name in JOINTS)
"""For each joint, the joint on the other side of the body (itself on the midline)."""

SIX_JOINTS = (
    JOINT["right_elbow"],
    JOINT["left_elbow"],
    JOINT["right_wrist"],
    JOINT["left_wrist"],
    JOINT["right_knee"],
    JOINT["left_knee"],
)
"""Elbows, wrists and knees: the joints on which Iskakov et al. report CMU -> Human3.6M."""

PELVIS = JOINT["pelvis"]
THORAX = JOINT["thorax"]
