"""A run's settings as TensorBoard's table of hyper-parameters takes them."""

from collections.abc import Iterator, Mapping
from typing import Any

from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams


def flatten(config: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield ``("a.b", value)`` of nested settings, lists as text, classes by their names."""
    if isinstance(config, Mapping):
        for name, value in config.items():
            if name == "_target_" and "." in path:
                yield path, str(value).rpartition(".")[2]
            elif not name.startswith("_"):
                yield from flatten(value, f"{path}.{name}")
    else:
        plain = isinstance(config, bool | int | float | str)
        yield path, config if plain else str(config)


def write_row(
    writer: SummaryWriter, values: Mapping[str, Any], metrics: Mapping[str, float]
) -> None:
    """Write a row: the settings beside the metrics, which are scalars of the same run.

    ``writer.add_hparams`` would write it to a second event file, with points of its own.
    """
    known = {key: value for key, value in values.items() if value is not None}
    for summary in hparams(known, dict(metrics)):
        writer._get_file_writer().add_summary(summary)
