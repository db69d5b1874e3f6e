"""Packages that only some estimators and loggers need, and the extras of ghpt that bring them."""

import logging
from importlib.util import find_spec
from typing import Any

from ghpt.config import Target, build
from ghpt.errors import GhptConfigError

EXTRAS = {
    "pycolmap": "colmap",
    "cv2": "opencv",
    "wandb": "wandb",
    "mlflow": "mlflow",
    "optuna": "optuna",
    "psutil": "device",
    "mediapipe": "detect",
    "aniposelib": "anipose",
}
"""The extra of each package, which has the name by which it is imported."""
_log = logging.getLogger(__name__)


class NotInstalled(GhptConfigError):
    """A setting needs a package that is not installed."""

    def __init__(self, user: str, package: str) -> None:
        self.package = package
        problem = f"needs {package}, which is not installed"
        super().__init__(user, problem, f"Run: pip install 'ghpt[{EXTRAS[package]}]'")


def is_installed(package: str) -> bool:
    """Return whether a package can be imported."""
    return find_spec(package) is not None


def check_installed(package: str, user: str) -> None:
    """Raise NotInstalled if the package that ``user`` needs is not there."""
    if not is_installed(package):
        raise NotInstalled(user, package)


def build_installed(group: Target, path: str) -> dict[str, Any]:
    """Build each estimator of a group; leave out those whose package is not installed.

    A warning says which, and what to install. ``path`` is the key that the group stands under.
    Raises what `build` raises.
    """
    built = {}
    for name, node in group.items():
        try:
            built[name] = build(node, f"{path}.{name}")
        except NotInstalled as error:
            _log.warning("No row of %s: it %s. %s", error.key, error.problem, error.hint)
    return built
