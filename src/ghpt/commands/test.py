"""Testing: predictions first, then every number, table and figure from the predictions."""

import logging
import shutil
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.lost import told
from ghpt.commands.outputs import Files, input_paths
from ghpt.commands.train import display_path, make_trainer, progress
from ghpt.config import build, check_type
from ghpt.errors import GhptCheckpointError
from ghpt.files import sweep_temporaries
from ghpt.models.checkpoint import load_model
from ghpt.models.pose.evaluation import write_metrics
from ghpt.models.pose.problem import PoseTriangulation
from ghpt.models.relative_pose.problem import RelativePose
from ghpt.provenance import provenance
from ghpt.report.pairs import PAIRS
from ghpt.report.poses import POSES
from ghpt.report.report import Report
from ghpt.report.tables import title

REPORTS: dict[type, Report] = {PoseTriangulation: POSES, RelativePose: PAIRS}
_log = logging.getLogger(__name__)


class Settings(TypedDict):
    """What `test` needs of the configuration, whatever the problem; see also ``Report.settings``."""

    ckpt: str | None
    trust: NotRequired[list[str]]
    hypotheses: int | None
    data: dict[str, Any]
    trainer: dict[str, Any]
    seed: int
    progress_bar: bool


def files(config: dict[str, Any]) -> Files:
    """What a test reads and writes. Raises GhptConfigError for settings that cannot work."""
    check_type(config, Settings, "")
    names = ("predictions.npz", "metrics.json", "report.md")
    return Files(input_paths(config), names, growing=(".predictions",))


def test(config: dict[str, Any], output: Path) -> dict[str, Any]:
    """Test ``config["ckpt"]`` on ``config["data"]``; returns what metrics.json holds.

    Writes predictions.npz, metrics.json, report.md and TensorBoard events into ``output`` and
    prints the table.
    """
    measured = measure(config, output)
    if measured is None:
        return {}
    report, predictions, metrics = measured
    report.write_report(output / "report.md", metrics)
    report.write_events(output, predictions, metrics)
    report.print_table(metrics)
    _log.info(
        "Report: %s, beside it metrics.json and predictions.npz.",
        display_path(output / "report.md"),
    )
    _log.info("Figures: tensorboard --logdir %s", display_path(output))
    return metrics


def measure(config: dict[str, Any], output: Path) -> tuple[Report, Any, dict[str, Any]] | None:
    """The part of `test` that computes: writes predictions.npz and metrics.json into ``output``.

    Returns the problem's report, the opened predictions and the metrics; None on all processes but
    the first.
    """
    check_type(config, Settings, "")
    if not config["ckpt"]:
        raise GhptCheckpointError(
            "ckpt", "is missing", "Name one: python test.py ckpt=runs/cmu2/last.ckpt data=h36m"
        )
    changes = {
        "hypotheses": config["hypotheses"],
        "seed": config["seed"],
        "problem.frames": config.get("frames"),
    }
    model, trained = load_model(config["ckpt"], config.get("trust") or (), **changes)
    kinds = type(model.problem).__mro__  # a class derived from one of ours has its report
    report = next((REPORTS[kind] for kind in kinds if kind in REPORTS), None)
    if report is None:
        raise GhptCheckpointError(
            config["ckpt"], f"is of a {type(model.problem).__name__}", "It has no report."
        )
    check_type(config, report.settings, "")
    data = build(config["data"], "data")
    data.bind(model.problem)
    origin = provenance(config["seed"]) | {
        "checkpoint": str(config["ckpt"]),
        "training": trained["provenance"],
    }
    meta = {
        "data": data.name,
        "source": data.source,
        "split": data.evaluate,
        "seed": config["seed"],
        "hypotheses": model.hypotheses,
        "provenance": origin,
    }
    estimators = report.estimators(config, model)
    trainer = make_trainer(
        config["trainer"],
        default_root_dir=output,
        logger=False,
        callbacks=[report.collect(output, estimators, meta), *progress(config)],
        enable_progress_bar=config["progress_bar"],
    )
    sweep_temporaries(output)
    shutil.rmtree(output / ".predictions", ignore_errors=True)  # what a killed test left
    with told(trainer):
        trainer.test(model, datamodule=data, verbose=False)
    if not trainer.is_global_zero:
        return None
    predictions = report.open(output / "predictions.npz")
    metrics = report.evaluate(predictions)
    write_metrics(output / "metrics.json", metrics)
    return report, predictions, metrics


def summary(metrics: dict[str, Any]) -> str:
    """What `test` returned, in words."""
    weight = metrics["selections"]["weight"]
    error = next(
        weight[report.headline] for report in REPORTS.values() if report.headline in weight
    )
    return f"{title(metrics)}: {'–' if error is None else f'{error:.1f} mm'}"


test.__test__ = False  # not one for pytest


COMMAND = Command(name="test", settings=dict, task=test, summary=summary, files=files)


if __name__ == "__main__":
    run_by_name("test")
