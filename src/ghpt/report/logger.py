"""A TensorBoard logger that cannot stop training."""

import functools
import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from lightning.fabric.loggers import TensorBoardLogger as EventsOnly
from lightning.pytorch.loggers import MLFlowLogger, TensorBoardLogger
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from tensorboard.summary.writer import event_file_writer

from ghpt.files import errors_name
from ghpt.report.hyperparameters import write_row

_log = logging.getLogger(__name__)


class _QuietThread(event_file_writer._AsyncWriterThread):
    """Writes the events. Its failure is raised again at the next event, and logged there."""

    def run(self) -> None:
        with suppress(Exception):
            super().run()


event_file_writer._AsyncWriterThread = _QuietThread


def _forgiving(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return the method with its errors counted and logged instead of raised."""

    @functools.wraps(method)
    def wrapped(self: "ForgivingTensorBoard", *args: Any, **kwargs: Any) -> Any:
        try:
            return method(self, *args, **kwargs)
        except Exception as error:
            # A full disk, a lost mount: the numbers matter less than the run.
            self.failures += 1
            if self.failures == 1:
                _log.warning("TensorBoard logging fails (%s); training goes on without it", error)
            return None

    return wrapped


class ForgivingTensorBoard(TensorBoardLogger):
    """Writes event files directly into ``save_dir``, and no hparams.yaml.

    The checkpoint has all settings. A failure is counted in ``failures`` and logged once.
    """

    def __init__(self, save_dir: Path) -> None:
        super().__init__(save_dir=save_dir, name="", version="", default_hp_metric=False)
        self.failures = 0

    @property
    def experiment(self) -> Any:
        """The writer.

        An event file that cannot even be begun stops the training: its folder is of no use.
        """
        with errors_name(Path(self.log_dir)):
            return super().experiment

    @_forgiving
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Write the metrics of a step; the epoch, which Lightning adds, is no curve."""
        shown = {name: value for name, value in metrics.items() if name != "epoch"}
        super().log_metrics(shown, step)

    @rank_zero_only
    @_forgiving
    def log_hyperparams(self, params: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """Write the run's row of hyper-parameters beside its metrics, which are curves already."""
        write_row(self.experiment, params, metrics)

    save = _forgiving(EventsOnly.save)
    finalize = _forgiving(TensorBoardLogger.finalize)


def mlflow(
    save_dir: str, experiment_name: str, run_name: str | None, tracking_uri: str | None
) -> MLFlowLogger:
    """Return Lightning's logger for MLflow, which by default writes ``mlflow.db`` in ``save_dir``.

    MLflow takes folders, Lightning's default, no longer.
    """
    database = (Path(save_dir) / "mlflow.db").resolve().as_posix()
    return MLFlowLogger(
        experiment_name=experiment_name,
        run_name=run_name,
        tracking_uri=tracking_uri or f"sqlite:///{database}",
        save_dir=save_dir,
    )
