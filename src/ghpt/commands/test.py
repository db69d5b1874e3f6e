"""Testing: predictions first, then every number, table and figure from the predictions."""

import logging
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.display import display_path
from ghpt.commands.lost import report_end
from ghpt.commands.outputs import Files, OutputSettings, input_paths
from ghpt.commands.people import PeopleResult, is_of_people, test_people
from ghpt.commands.trainer import make_trainer, progress
from ghpt.config import Target, build
from ghpt.errors import GhptCheckpointError
from ghpt.files import sweep_temporaries, write_json
from ghpt.models.checkpoint import load_model
from ghpt.models.collect import CollectPredictions
from ghpt.models.measured import Measured, Number
from ghpt.models.predictions import Predictions, open_predictions
from ghpt.models.problem import BaselineSettings, Problem
from ghpt.provenance import provenance
from ghpt.report.markdown import write_markdown
from ghpt.report.tables import NONE, title
from ghpt.report.terminal import print_document

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TestSettings(OutputSettings):
    """The settings of `test`."""

    __test__ = False  # not one for pytest

    ckpt: str | None
    """The checkpoint of a training; there is no default."""
    trust: tuple[str, ...] = ()
    """Packages whose classes the checkpoint may name."""
    hypotheses: int | None
    """Hypotheses of a sample; None: as many as in training."""
    frames: int | None
    """Frames of a pair of cameras; None: as many as in training."""
    data: Target
    trainer: Target
    baselines: Target = field(default_factory=dict)
    camera_baselines: Target = field(default_factory=dict)
    trajectory: Target | None = None
    seed: int
    progress_bar: bool

    def estimators(self) -> BaselineSettings:
        """Return what is tested beside the model."""
        return BaselineSettings(self.baselines, self.camera_baselines, self.trajectory)


@dataclass(frozen=True)
class TestResult:
    """What a test measured; of several processes, the first one alone has it."""

    __test__ = False  # not one for pytest

    problem: Problem
    predictions: Predictions[Any, Any, Any]
    measured: Measured[Any]

    @property
    def error(self) -> float | None:
        """The headline number under ``weight``, mm; None where nothing was compared."""
        error: Number = self.measured.selections["weight"].headline
        return error


def files(settings: TestSettings) -> Files:
    """Return what a test reads and writes."""
    names = ("predictions.npz", "metrics.json", "report.md")
    root = settings.data.get("root")
    return Files(input_paths(settings.ckpt, root), names, growing=(".predictions",))


def test(settings: TestSettings, output: Path) -> TestResult | PeopleResult | None:
    """Test a checkpoint on a data set, and show the result.

    Writes predictions.npz, metrics.json, report.md and TensorBoard events into ``output`` and
    prints the table. Returns None on all processes but the first. Data of several people are
    another test: see `test_people`.
    """
    if is_of_people(settings.data):
        return test_people(
            settings.data,
            settings.baselines,
            settings.trajectory,
            settings.trainer,
            settings.ckpt,
            settings.seed,
            settings.progress_bar,
            output,
        )
    result = measure(settings, output)
    if result is None:
        return None
    report = result.problem.report()
    page = output / "report.md"
    write_markdown(page, report.document(result.measured))
    report.write_events(output, result.predictions, result.measured)
    print_document(report.summary(result.measured))
    _log.info("Report: %s, beside it metrics.json and predictions.npz.", display_path(page))
    _log.info("Figures: tensorboard --logdir %s", display_path(output))
    return result


test.__test__ = False  # type: ignore[attr-defined]  # not one for pytest


def measure(settings: TestSettings, output: Path) -> TestResult | None:
    """Write predictions.npz and metrics.json: the part of `test` that computes.

    Returns None on all processes but the first.
    """
    if not settings.ckpt:
        hint = "Name one: python test.py ckpt=runs/cmu2/last.ckpt data=h36m"
        raise GhptCheckpointError("ckpt", "is missing", hint)
    changes = {
        "hypotheses": settings.hypotheses,
        "seed": settings.seed,
        "problem.frames": settings.frames,
    }
    model, trained = load_model(settings.ckpt, settings.trust, **changes)
    problem = model.problem
    data = build(settings.data, "data")
    data.bind(problem)
    origin = provenance(settings.seed) | {
        "checkpoint": settings.ckpt,
        "training": trained["provenance"],
    }
    meta = {
        "data": data.name,
        "source": data.source,
        "split": data.evaluate,
        "seed": settings.seed,
        "hypotheses": model.hypotheses,
        "model": trained["config"]["model"],
        "provenance": origin,
    }
    baselines = problem.baselines(settings.estimators(), model)
    collect = CollectPredictions(output, problem, baselines, meta)
    trainer = make_trainer(
        settings.trainer,
        default_root_dir=output,
        logger=False,
        callbacks=[collect, *progress(settings.progress_bar)],
        enable_progress_bar=settings.progress_bar,
    )
    sweep_temporaries(output)
    shutil.rmtree(output / ".predictions", ignore_errors=True)  # what a killed test left
    with report_end(trainer):
        trainer.test(model, datamodule=data, verbose=False)
    if not trainer.is_global_zero:
        return None
    predictions = open_predictions(collect.path, problem.schema)
    measured = problem.metrics(predictions)
    write_json(output / "metrics.json", measured.plain())
    return TestResult(problem, predictions, measured)


def summary(result: TestResult | PeopleResult | None) -> str:
    """Return the result in one line."""
    if result is None:
        return ""
    if isinstance(result, PeopleResult):
        return result.words
    error = NONE if result.error is None else f"{result.error:.1f} mm"
    return f"{title(result.measured.run)}: {error}"


COMMAND = Command(name="test", settings=TestSettings, task=test, summary=summary, files=files)


if __name__ == "__main__":
    run_by_name("test")
