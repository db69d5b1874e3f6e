"""The paper's numbers (Bartol et al., CVPR 2022), by the label of their table; MPJPE in mm unless
stated.
"""

QUANTITATIVE_HYPOTHESES = {
    "h36m": {
        "weight": 29.1,
        "average": 31.2,
        "most": 41.3,
        "least": 74.5,
        "stochastic": 41.3,
        "random": 45.0,
        "best": 22.3,
        "worst": 98.9,
        "ransac": 27.4,
    },
    "panoptic": {
        "weight": 24.9,
        "average": 25.9,
        "most": 25.0,
        "least": 29.8,
        "stochastic": 26.5,
        "random": 26.1,
        "best": 24.4,
        "worst": 31.0,
        "ransac": 39.5,
    },
}
"""tab:quantitative-hypotheses: data set -> selection. Trained and tested on the same data set."""

QUANTITATIVE = {
    "Directions": 27.5,
    "Discussion": 28.4,
    "Eating": 29.3,
    "Greeting": 27.5,
    "Phoning": 30.1,
    "TakingPhoto": 28.1,
    "Posing": 27.9,
    "Purchases": 30.8,
    "Sitting": 32.9,
    "SittingDown": 32.5,
    "Smoking": 30.8,
    "Waiting": 29.4,
    "WalkingDog": 28.5,
    "Walking": 30.5,
    "WalkingTogether": 30.1,
}
"""tab:quantitative, row "Ours" (weight): action of Human3.6M."""
QUANTITATIVE_MEAN = 29.1

ARRANGEMENTS = ("cmu1", "cmu2", "cmu3", "cmu4", "h36m")
"""The rows and columns of tab:generalization-evaluation."""

GENERALIZATION = {
    (train, test): value
    for test, row in {
        "cmu1": (25.8, 25.8, 25.6, 25.2, 25.6),
        "cmu2": (25.4, 26.0, 25.5, 25.6, 25.9),
        "cmu3": (24.9, 26.0, 25.0, 25.0, 25.7),
        "cmu4": (25.1, 25.6, 25.3, 25.1, 25.5),
        "h36m": (33.5, 33.4, 31.0, 32.5, 29.1),
    }.items()
    for train, value in zip(ARRANGEMENTS, row, strict=True)
}
"""tab:generalization-evaluation: (train, test) -> weight. A row of the printed table is a *test*
set, a column a training set: tab:remelli-comparison reads it so (CMU1 -> H36M is 33.5), though the
caption says otherwise.
"""
GENERALIZATION_MAX_DIFFERENCE = {"cmu1": 2.3, "cmu2": 2.4, "cmu3": 4.4, "cmu4": 2.0, "h36m": 15.1}
"""Its last column, percent: (largest - smallest) / smallest of the row, which gives 2.38, 2.36,
4.42, 1.99 and 15.12: the first is cut, not rounded.
"""

QUANTITATIVE_OTHERS = {
    "Tome et al.": (
        43.3,
        49.6,
        42.0,
        48.8,
        51.1,
        64.3,
        40.3,
        43.3,
        66.0,
        95.2,
        50.2,
        52.2,
        51.1,
        43.9,
        45.3,
        52.8,
    ),
    "Kadkhodamohammadi et al.": (
        39.4,
        46.9,
        41.0,
        42.7,
        53.6,
        54.8,
        41.4,
        50.0,
        59.9,
        78.8,
        49.8,
        46.2,
        51.1,
        40.5,
        41.0,
        49.1,
    ),
    "Cross-view fusion": (
        28.9,
        32.5,
        26.6,
        28.1,
        28.3,
        29.3,
        28.0,
        36.8,
        41.0,
        30.5,
        35.6,
        30.0,
        28.3,
        30.0,
        30.5,
        31.2,
    ),
    "Remelli et al.": (
        27.3,
        32.1,
        25.0,
        26.5,
        29.3,
        35.4,
        28.8,
        31.6,
        36.4,
        31.7,
        31.2,
        29.9,
        26.9,
        33.7,
        30.4,
        30.2,
    ),
    "Epipolar transformers": (
        25.7,
        27.7,
        23.7,
        24.8,
        26.9,
        31.4,
        24.9,
        26.5,
        28.8,
        31.7,
        28.2,
        26.4,
        23.6,
        28.3,
        23.5,
        26.9,
    ),
}
"""tab:quantitative, the rows of other systems as printed: real Human3.6M, from images; the actions
in the order of ``QUANTITATIVE``, then their mean.
"""
QUANTITATIVE_COLUMNS = {
    "Directions": "Dir.",
    "Discussion": "Disc.",
    "Eating": "Eat",
    "Greeting": "Greet",
    "Phoning": "Phone",
    "TakingPhoto": "Photo",
    "Posing": "Pose",
    "Purchases": "Purch.",
    "Sitting": "Sit",
    "SittingDown": "SitD.",
    "Smoking": "Smoke",
    "Waiting": "Wait",
    "WalkingDog": "WalkD.",
    "Walking": "Walk",
    "WalkingTogether": "WalkT.",
}
"""Action -> its column of the printed table."""

ISKAKOV = {"theirs": 34.0, "ours": 31.0}
"""tab:iskakov-comparison, CMU3 -> Human3.6M. Theirs is on six joints alone (elbows, wrists, knees:
Iskakov et al., ICCV 2019, section 4.3); the paper's own number is on all 17.
"""

REMELLI = {"TC1, canonical fusion": (27.5, 38.2), "TC1, baseline": (39.3, 48.2)}
"""tab:remelli-comparison, their rows on Total Capture: base test, novel test."""
REMELLI_OURS = {
    "cmu1": (24.9, 25.8),
    "cmu3": (25.0, 25.6),
    "cmu4": (25.0, 25.6),
    "cmu2": (25.6, 26.0),
}
"""Its rows of the paper's own model: training set -> base and novel test. They are the smallest and
the largest number of the training set's column in tab:generalization-evaluation, not the base
arrangement and the others.
"""
REMELLI_INTER = (29.1, 33.5)
"""Its last row: the smallest and the largest of the row H36M."""

SOTA = {"RANSAC": 39.5, "algebraic": 33.4, "VoxelPose": 25.5, "ours": 25.4}
"""tab:sota-comparison on novel views of Panoptic; "ours" is the mean of the 12 values of
tab:generalization-evaluation that are off its diagonal.
"""

HYPERPARAMETERS = {
    "learning rate": ("5*10e-4", "10e-5"),
    "temperature": ("1.5", "1.2"),
    "alpha, beta, gamma": ("1.0, 0.01, 0.02", "1.0, 0.01, 0.0"),
    "layers": ("1000, 900, 900, 900, 700", "1000, 900, 900"),
    "hypotheses": ("200", "100"),
    "batch size": ("16", "16"),
    "frames M": ("", "80"),
    "training samples": ("500", ""),
}
"""Appendix C, tab:hyperparameters, as printed: 3D pose, camera; its last two are in the text."""

LIMITATION = {"train": 13.8, "validation": 14.2, "test": 29.1}
"""Appendix D, tab:limitation-table: split of Human3.6M, trained on Human3.6M."""

FUNDAMENTAL = {
    (1, 3): {"E_R": 1.7e-2, "E_t": 23.0, "E_2D": 3.7, "E_3D": 23.0},
    (2, 4): {"E_R": 3.2e-2, "E_t": 4.9, "E_2D": 1.3, "E_3D": 23.0},
    (1, 4): {"E_R": 9.8e-3, "E_t": 27.0, "E_2D": 2.3, "E_3D": 13.0},
    (2, 3): {"E_R": 2.1e-3, "E_t": 9.9, "E_2D": 0.72, "E_3D": 13.0},
    (3, 4): {"E_R": 4.7e-3, "E_t": 8.5, "E_2D": 1.2, "E_3D": 5.5},
    (1, 2): {"E_R": 4.8e-3, "E_t": 4.8, "E_2D": 0.81, "E_3D": 4.9},
}
"""tab:fundamental-evaluation, in its order: pair of Human3.6M's cameras -> errors (mm and pixels)
of the weighted hypothesis, trained and tested on Human3.6M. The paper calls (1, 3) and (2, 4)
diagonal. In the data set's order of cameras these stand side by side (43 degrees about the room's
middle, 3.7 m) and it is 1-4 and 2-3 that face each other; we read the table in the data set's order
all the same, because there too (1, 3) and (2, 4) are by far the worst.
"""

FUNDAMENTAL_FRAMES = 80
"""M of appendix C."""

FUNDAMENTAL_DISSECTION = {
    (1, 3): {
        "estimated_R": {"E_2D": 1.2, "E_3D": 10.8},
        "estimated_t": {"E_2D": 1.8, "E_3D": 18.2},
    },
    (2, 4): {"estimated_R": {"E_2D": 0.9, "E_3D": 9.7}, "estimated_t": {"E_2D": 1.6, "E_3D": 15.3}},
    (1, 4): {"estimated_R": {"E_2D": 0.9, "E_3D": 6.4}, "estimated_t": {"E_2D": 1.2, "E_3D": 8.9}},
    (2, 3): {"estimated_R": {"E_2D": 0.6, "E_3D": 3.9}, "estimated_t": {"E_2D": 1.0, "E_3D": 4.5}},
    (3, 4): {"estimated_R": {"E_2D": 0.4, "E_3D": 1.2}, "estimated_t": {"E_2D": 0.7, "E_3D": 4.0}},
    (1, 2): {"estimated_R": {"E_2D": 0.4, "E_3D": 1.8}, "estimated_t": {"E_2D": 0.7, "E_3D": 3.7}},
}
"""Appendix A, tab:fundamental-dissection: the errors when one part of the pose is estimated and the
other is true.
"""

UNKNOWN_EXTRINSICS = {
    "h36m": {"known": 29.1, "R": 29.4, "t": 36.7, "both": 37.3},
    "cmu3": {"known": 31.0, "R": 33.6, "t": 42.2, "both": 44.5},
}
"""Appendix A, tab:unknown-extrinsics-evaluation: training set -> which part of Human3.6M's
extrinsics is estimated.
"""


def paper_value(data: str, selection: str, trained_on: str | None) -> float | None:
    """The paper's pelvis-relative MPJPE of a selection on the test split of ``data``; None where it
    prints none.

    ``weight`` depends on the training set: tab:generalization-evaluation. The other rows are
    tab:quantitative-hypotheses, which has one column for all of Panoptic; ``most``, ``least`` and
    ``stochastic`` need a scorer trained on the same data set.
    """
    if selection == "weight":
        return None if trained_on is None else GENERALIZATION.get((trained_on, data))
    column = _column(data)
    if selection in ("most", "least", "stochastic") and _column(trained_on) != column:
        return None
    return QUANTITATIVE_HYPOTHESES.get(column, {}).get(selection)


def _column(data: str | None) -> str:
    return "h36m" if data == "h36m" else "panoptic" if data in ARRANGEMENTS else ""
