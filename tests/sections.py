"""What the tests of the paper's artefacts share: small setups, and a section as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from ghpt.config import settings
from ghpt.paper.engine.artefact import Section
from ghpt.paper.engine.settings import Overrides, Sizes
from ghpt.paper.engine.setup import Setup
from ghpt.report.document import Document
from ghpt.report.markdown import render_markdown

CONF = Path(__file__).resolve().parents[1] / "conf"
SYNTHETIC: Mapping[str, str | None] = {"human36m": None, "panoptic": None}


def setup(
    seed: int = 0,
    roots: Mapping[str, str | None] = SYNTHETIC,
    train: tuple[str, ...] = (),
    **changes: Mapping[str, Any],
) -> Setup:
    """Return a setup whose sizes are those of conf/reproduce.yaml with some groups changed."""
    text = (CONF / "reproduce.yaml").read_text(encoding="utf-8")
    sizes = yaml.safe_load(text)["sizes"]
    for group, values in changes.items():
        sizes[group] |= values
    return Setup(CONF, roots, Overrides(train=train), settings(Sizes, sizes), seed)


def markdown(section: Section) -> str:
    """Return what a section shows as Markdown."""
    return render_markdown(Document("", section.blocks))
