"""reproduce.py as it is typed, with models of 16 samples."""

import json
from pathlib import Path

import pytest

from ghpt.commands import reproduce
from ghpt.commands.overrides import spread_seeds
from ghpt.commands.reproduce import ARTEFACTS, choose
from ghpt.errors import GhptConfigError

CONF = Path(__file__).resolve().parents[1] / "conf"
SMALL = (
    "overrides.train=['data.train_samples=16','model.hypotheses=8','data.stride=4096']",
    "overrides.test=['data.stride=4096','hypotheses=8']",
    "jobs=1",
    "progress_bar=false",
)
PAPER = (
    "generalization-evaluation",
    "iskakov-comparison",
    "remelli-comparison",
    "sota-comparison",
    "quantitative",
    "quantitative-hypotheses",
    "fundamental-evaluation",
    "unknown-extrinsics-evaluation",
    "fundamental-dissection",
    "hyperparameters",
    "limitation-table",
    "qualitative",
    "pose-prior",
    "comparison-to-8-point",
)


@pytest.fixture
def command(typed, little_data, tmp_path):
    def call(*words):
        flags = [word for word in words if word == "-m"]  # Hydra wants them first
        settings = [*SMALL, *(word for word in words if word not in flags)]
        folders = [f"output={tmp_path / 'report'}", f"tasks={tmp_path / 'tasks'}"]
        return typed(CONF, reproduce.command(CONF), [*flags, *settings, *folders])

    return call


def numbers(folder):
    return json.loads((folder / "report.json").read_text())["items"]["iskakov-comparison"][
        "numbers"
    ]


def test_one_table_then_nothing_to_do_then_another_seed(command, tmp_path):
    status, _, said = command("only=[iskakov-comparison]")
    assert status == 0, said
    assert "claims hold" in said
    text = (tmp_path / "report" / "report.md").read_text()
    assert (
        "tab:iskakov-comparison: From Panoptic to Human3.6M, beside Iskakov et al. · synthetic"
        in text
    )
    assert (
        "for 5 tasks that were not there before" in text
    )  # three splits prepared, a training, a test
    first = numbers(tmp_path / "report")
    assert command("only=[tab:iskakov-comparison]")[0] == 0
    assert "for 0 tasks" in (tmp_path / "report" / "report.md").read_text()
    assert numbers(tmp_path / "report") == first

    status, printed, said = command("only=[iskakov-comparison]", "-m", "seeds=2")
    assert status == 0, said
    assert "0_seed-0: " in printed
    assert "1_seed-1: " in printed
    both = numbers(tmp_path / "report")
    assert both[0]["ours"][0] == first[0]["ours"][0]
    assert len(both[0]["ours"]) == 2
    assert both[0]["ours"][0] != both[0]["ours"][1]
    text = (tmp_path / "report" / "report.md").read_text()
    assert "seeds: 2 (0, 1)" in text
    assert "for 0 tasks" in text  # the jobs have made them
    assert "±" in text


def test_hyperparameters_need_no_cell(command, tmp_path):
    assert command("only=[hyperparameters]")[0] == 0
    text = (tmp_path / "report" / "report.md").read_text()
    assert "for 0 tasks" in text
    assert "| hypotheses" in text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["only=[generalisation]"],
            "only: there is no 'generalisation'. Did you mean 'generalization-evaluation'?",
        ),
        (["seeds=0"], "seeds: is 0. It must be >= 1."),
        (["jobs=0"], "jobs: is 0. It must be >= 1, or null."),
        (
            ["data.root={tmp}"],
            "has no folder human36m. Put the data set there, or name its folder alone",
        ),
        (
            ["only=[limitation-table]", "data.human36m={tmp}/none"],
            "none: data.root: there is no such folder",
        ),
        (["only=[limitation-table]", "overrides.train=['model.hypothesis=3']"], "hypothes"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(command, tmp_path, words, said):
    status, _, error = command(*(word.format(tmp=tmp_path) for word in words))
    assert status == 1
    assert said in error
    assert "Traceback" not in error
    assert not (tmp_path / "report" / "report.md").exists()


def test_every_table_and_figure_of_the_paper_is_an_item():
    assert {
        label
        for label, artefact in ARTEFACTS.items()
        if artefact.kind in ("table", "figure") and artefact.of_paper
    } == set(PAPER)
    assert sum(artefact.kind == "ablation" for artefact in ARTEFACTS.values()) >= 5
    assert sum(artefact.kind == "robustness" for artefact in ARTEFACTS.values()) >= 5
    assert [artefact.label for artefact in choose(["fig:pose-prior", "tab:sota-comparison"])] == [
        "sota-comparison",
        "pose-prior",
    ]
    assert choose("pose-prior") == choose(["pose-prior"])
    assert {artefact.kind for artefact in choose(["ablation", "figure"])} == {"ablation", "figure"}
    with pytest.raises(GhptConfigError, match="there is no 'nothing'"):
        choose(["nothing"])


@pytest.mark.parametrize(
    ("typed_words", "run"),
    [
        (["x.py", "-m", "seeds=3"], ["x.py", "-m", "seed=0,1,2"]),
        (["x.py", "seeds=2", "--multirun", "seed=5"], ["x.py", "--multirun", "seed=5,6"]),
        (["x.py", "seeds=3"], ["x.py", "seeds=3"]),
        (["x.py", "-m", "seed=1,4"], ["x.py", "-m", "seed=1,4"]),
        (["x.py", "-m", "seeds=many"], ["x.py", "-m", "seeds=many"]),
    ],
)
def test_a_sweep_spreads_its_seeds_over_jobs(typed_words, run):
    assert spread_seeds(typed_words) == run
